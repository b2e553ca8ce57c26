// SPDX-License-Identifier: MIT
// The tangent of cables off the diagonal: every two nodes of one couple (formulas: cable.py).
#include "coalesced_io.cuh"

struct CableBlocks {
    int n;                    // blocks above the diagonal
    int accumulate;           // 0: write, 1: add to what another effect wrote
    const int* start;         // (n + 1,) into pairs
    const int* pairs;         // (start[n],) 4 e + 2 a + b: the pair e couples the block's row and column
    const int* guide;         // (pairs of nodes, 2) rows of slope
    const int* joined;        // (pairs of nodes, 2) cable, and segment between them or -1
    const real* segment;      // (segments, 8) unit vector e, length [m], ...
    const real* state;        // (cables, 4) tension [N], length [m], stiffness in force [N/m], ...
    const real* coefficient;  // (cables,) h (c + beta): factor of K in A [s2]
    const real* slope;        // (guides, 3) g
    own<local> sums;          // (n, 9) out, world frame, row major [kg]
};

INLINE void blocks_add(const CableBlocks& p, int, int k, local* sum) {
    const int code = p.pairs[k], pair = code >> 2, cable = p.joined[2 * pair], between = p.joined[2 * pair + 1];
    const real *state = p.state + 4 * cable, factor = p.coefficient[cable], stiffness = factor * state[2];
    const real *a = p.slope + 3 * p.guide[2 * pair + ((code >> 1) & 1)], *b = p.slope + 3 * p.guide[2 * pair + (code & 1)];
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) sum[3 * r + c] += stiffness * a[r] * b[c];
    if (between < 0) return;
    const real *e = p.segment + 8 * (long long)between, across = e[3] > 0 ? factor * state[0] / e[3] : (real)0;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) sum[3 * r + c] -= across * ((r == c ? (real)1 : (real)0) - e[r] * e[c]);
}

INLINE void blocks_put(const CableBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, p.accumulate ? row_at<9>(p.sums, i, m) + sum[m] : sum[m]);
}

SUM_KERNEL(blocks, CableBlocks, 9)
