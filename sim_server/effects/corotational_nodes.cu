// SPDX-License-Identifier: MIT
// Collects at each node what its elements left for it: a gather, so that no two items write one place.
#include "together.cuh"

struct Gather {
    int n;                // nodes
    const int* start;     // (n + 1,) into corners
    const int* corners;   // (start[n],) slots 4 e + a of the elements at the node
    const local* push;    // (elements, 4, 3) [N s]
    const local* spread;  // (elements, 4, 4) scaled rotated gradients g_a, lambda / mu
    const local* turn;    // (elements, 4) unit quaternions
    own<real> b;          // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;     // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;      // (n, 10) in, out: upper triangle of the sum of q q^T, q the elements' rotations
};

// The mean of rotations is linear in the products of their quaternions, of which a node needs ten.
INLINE void gather_add(const Gather& p, int, int k, local* sum) {
    int corner = p.corners[k];
    const local* f = p.push + 3 * corner;
    local g[4], q[4];
    get_row(p.spread, corner, g);
    get_row(p.turn, corner >> 2, q);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    // (lambda / mu + 1) g g^T + (g . g) I: h (c + beta) K_aa
    local w = g[3] + 1, x = w * g[0], y = w * g[1], d = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
    sum[3] += x * g[0] + d; sum[4] += x * g[1]; sum[5] += x * g[2];
    sum[6] += y * g[1] + d; sum[7] += y * g[2]; sum[8] += w * g[2] * g[2] + d;
    sum[9] += q[0] * q[0]; sum[10] += q[0] * q[1]; sum[11] += q[0] * q[2]; sum[12] += q[0] * q[3];
    sum[13] += q[1] * q[1]; sum[14] += q[1] * q[2]; sum[15] += q[1] * q[3];
    sum[16] += q[2] * q[2]; sum[17] += q[2] * q[3]; sum[18] += q[3] * q[3];
}

INLINE void gather_put(const Gather& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, row_at<10>(p.mean, i, m) + sum[9 + m]);
}

SUM_KERNEL(gather, Gather, 19)
