// SPDX-License-Identifier: MIT
// What patches of strain cells add to the tangent: one matrix of rank one each, w g g^T, block after block. All are gathers: no two
// items write to the same place.
#include "coalesced_io.cuh"

struct PatchNodes {
    int n;                         // nodes
    const int* start;              // (n + 1,) into corners
    const int* corners;            // (start[n],) corners of patches at the node
    const local* patch_gradients;  // (corners, 4) gradient g, and the weight w of w g g^T
    own<local> block;              // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
};

INLINE void own_blocks_add(const PatchNodes& p, int, int k, local* sum) {
    local g[4];
    get_row(p.patch_gradients, p.corners[k], g);
    const local x = g[3] * g[0], y = g[3] * g[1], z = g[3] * g[2];
    sum[0] += x * g[0]; sum[1] += x * g[1]; sum[2] += x * g[2];
    sum[3] += y * g[1]; sum[4] += y * g[2]; sum[5] += z * g[2];
}

INLINE void own_blocks_put(const PatchNodes& p, int i, const local* sum) {
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[m]);
}

SUM_KERNEL(own_blocks, PatchNodes, 6)

struct PatchBlocks {
    int n;                         // blocks above the diagonal
    const int* start;              // (n + 1,) into pairs
    const int* pairs;              // (start[n], 2) corners of patches at the block's row and column
    const local* patch_gradients;  // (corners, 4) gradient g, and the weight w of w g g^T
    own<local> sums;               // (n, 9) in, out, world frame, row major [kg]
};

INLINE void blocks_add(const PatchBlocks& p, int, int k, local* s) {
    local a[4], b[4];
    get_row(p.patch_gradients, p.pairs[2 * k], a);
    get_row(p.patch_gradients, p.pairs[2 * k + 1], b);
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) s[3 * r + c] += a[3] * a[r] * b[c];
}

INLINE void blocks_put(const PatchBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, row_at<9>(p.sums, i, m) + sum[m]);
}

SUM_KERNEL(blocks, PatchBlocks, 9)
