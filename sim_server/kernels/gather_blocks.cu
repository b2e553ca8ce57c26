// SPDX-License-Identifier: MIT
// Sums the edge blocks of tetrahedra (kernels/hyperelastic.cuh) into the blocks of A above the diagonal. A gather from a list made
// once per topology, in its order. An edge of an element is stored once, from its lower to its higher corner; a block that couples
// them in the other order takes the transpose.
#include "coalesced_io.cuh"

struct GatherBlocks {
    int n;               // blocks above the diagonal
    int elements;
    int accumulate;      // 0: write, 1: add to what another effect wrote
    const int* start;    // (n + 1,) into pairs
    const int* pairs;    // (start[n],) 16 e + 4 a + b: corners a and b of element e are at the block's row and column
    const local* edges;  // (6, elements, 9) blocks of the edges 01, 02, 03, 12, 13, 23 [kg]
    own<local> sums;     // (n, 9) out, world frame, row major [kg]
};

INLINE void gather_add(const GatherBlocks& p, int, int k, local* sum) {
    int pair = p.pairs[k], a = (pair >> 2) & 3, b = pair & 3;
    int low = a < b ? a : b, edge = low ? a + b : a + b - 1;
    const local* m = p.edges + 9 * ((long long)p.elements * edge + (pair >> 4));
    local row[9];
    for (int j = 0; j < 9; ++j) row[j] = m[j];
    bool transposed = a > b;
    sum[0] += row[0]; sum[1] += transposed ? row[3] : row[1]; sum[2] += transposed ? row[6] : row[2];
    sum[3] += transposed ? row[1] : row[3]; sum[4] += row[4]; sum[5] += transposed ? row[7] : row[5];
    sum[6] += transposed ? row[2] : row[6]; sum[7] += transposed ? row[5] : row[7]; sum[8] += row[8];
}

INLINE void gather_put(const GatherBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, p.accumulate ? row_at<9>(p.sums, i, m) + sum[m] : sum[m]);
}

SUM_KERNEL(gather, GatherBlocks, 9)
