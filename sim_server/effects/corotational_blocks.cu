// SPDX-License-Identifier: MIT
// Sums the element tangents of corotational tetrahedra block by block: with g_a the scaled rotated gradient of node a,
// h (c + beta) K_ab = (lambda / mu) g_a g_b^T + g_b g_a^T + (g_a . g_b) I. A block gathers its elements from a list made once
// per topology: no atomics, the same sum in the same order every time, and no 12x12 matrix is ever formed. The nodes' own
// blocks, those on the diagonal, are corotational_nodes.cu's.
#include "together.cuh"

struct Blocks {
    int n;                // blocks above the diagonal
    int accumulate;       // 0: write, 1: add to what another effect wrote
    const int* start;     // (n + 1,) into pairs
    const int* pairs;     // (start[n],) 16 e + 4 a + b: corners a and b of element e are at the block's row and column
    const local* spread;  // (elements, 4, 4) g_a, lambda / mu
    own<local> sums;      // (n, 9) out, world frame, row major [kg]
};

INLINE void blocks_add(const Blocks& p, int, int k, local* s) {
    int pair = p.pairs[k];
    local a[4], b[4];
    get_row(p.spread, pair >> 2, a);
    get_row(p.spread, (pair >> 4) * 4 + (pair & 3), b);
    local wx = a[3] * a[0], wy = a[3] * a[1], wz = a[3] * a[2], d = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    s[0] += wx * b[0] + b[0] * a[0] + d; s[1] += wx * b[1] + b[0] * a[1];     s[2] += wx * b[2] + b[0] * a[2];
    s[3] += wy * b[0] + b[1] * a[0];     s[4] += wy * b[1] + b[1] * a[1] + d; s[5] += wy * b[2] + b[1] * a[2];
    s[6] += wz * b[0] + b[2] * a[0];     s[7] += wz * b[1] + b[2] * a[1];     s[8] += wz * b[2] + b[2] * a[2] + d;
}

INLINE void blocks_put(const Blocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, p.accumulate ? row_at<9>(p.sums, i, m) + sum[m] : sum[m]);
}

SUM_KERNEL(blocks, Blocks, 9)
