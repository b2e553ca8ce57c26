// SPDX-License-Identifier: MIT
// Sums the exact tangents of corotational tetrahedra block by block (corotational_exact.cu), as corotational_blocks.cu does.
#include "corotational_tangent.cuh"

struct CorotationalExactBlocks {
    int n;                          // blocks above the diagonal
    int accumulate;                 // 0: write, 1: add to what another effect wrote
    const int* start;               // (n + 1,) into pairs
    const int* pairs;               // (start[n],) 16 e + 4 a + b: corners a and b of element e are at the block's row and column
    const local* scaled_gradients;  // (elements, 4, 4) g_a, lambda / mu
    const local* twist;             // (elements, 6) E
    own<local> sums;                // (n, 9) out, world frame, row major [kg]
};

INLINE void blocks_add(const CorotationalExactBlocks& p, int, int k, local* s) {
    int pair = p.pairs[k];
    local a[4], b[4];
    get_row(p.scaled_gradients, pair >> 2, a);
    get_row(p.scaled_gradients, (pair >> 4) * 4 + (pair & 3), b);
    add_block(s, a, b);
    add_twist(s, a, b, p.twist + 6 * (pair >> 4));
}

INLINE void blocks_put(const CorotationalExactBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, p.accumulate ? row_at<9>(p.sums, i, m) + sum[m] : sum[m]);
}

SUM_KERNEL(blocks, CorotationalExactBlocks, 9)
