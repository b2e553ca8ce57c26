// SPDX-License-Identifier: MIT
// The tangent of springs off the diagonal, -(g g^T + d I): one spring a block, or a few side by side.
#include "coalesced_io.cuh"

struct MassSpringBlocks {
    int n;                 // blocks above the diagonal
    int accumulate;        // 0: write, 1: add to what another effect wrote
    const int* start;      // (n + 1,) into pairs
    const int* pairs;      // (start[n],) 4 e + 2 a + b: spring e joins the block's row and column
    const local* tangent;  // (springs, 4) g, d
    own<local> sums;       // (n, 9) out, world frame, row major [kg]
};

INLINE void blocks_add(const MassSpringBlocks& p, int, int k, local* s) {
    local g[4];
    get_row(p.tangent, p.pairs[k] >> 2, g);
    local xy = g[0] * g[1], xz = g[0] * g[2], yz = g[1] * g[2];
    s[0] -= g[0] * g[0] + g[3]; s[1] -= xy; s[2] -= xz;
    s[3] -= xy; s[4] -= g[1] * g[1] + g[3]; s[5] -= yz;
    s[6] -= xz; s[7] -= yz; s[8] -= g[2] * g[2] + g[3];
}

INLINE void blocks_put(const MassSpringBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, p.accumulate ? row_at<9>(p.sums, i, m) + sum[m] : sum[m]);
}

SUM_KERNEL(blocks, MassSpringBlocks, 9)
