// SPDX-License-Identifier: MIT
// Sums nodal impulses and diagonal blocks of the springs at each node. A gather: no two items write to the same place.
#include "coalesced_io.cuh"

struct MassSpringNodes {
    int n;                       // nodes
    const int* start;            // (n + 1,) into corners
    const int* corners;          // (start[n],) 2 e + a: end a of spring e is at the node
    const local* nodal_impulse;  // (springs, 3) of the first end [N s]
    const local* tangent;        // (springs, 4) g, d
    own<real> b;                 // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;            // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
};

INLINE void gather_add(const MassSpringNodes& p, int, int k, local* sum) {
    int corner = p.corners[k];
    const local* f = p.nodal_impulse + 3 * (corner >> 1);
    const local sign = corner & 1 ? -1 : 1;
    local g[4];
    get_row(p.tangent, corner >> 1, g);
    for (int m = 0; m < 3; ++m) sum[m] += sign * f[m];
    sum[3] += g[0] * g[0] + g[3]; sum[4] += g[0] * g[1]; sum[5] += g[0] * g[2];
    sum[6] += g[1] * g[1] + g[3]; sum[7] += g[1] * g[2]; sum[8] += g[2] * g[2] + g[3];
}

INLINE void gather_put(const MassSpringNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
}

SUM_KERNEL(gather, MassSpringNodes, 9)
