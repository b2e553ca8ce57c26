// SPDX-License-Identifier: MIT
// Sums nodal impulses, diagonal blocks and rotations of the elements at each node, for the exact tangent (corotational_exact.cu).
#include "corotational_tangent.cuh"

struct CorotationalExactNodes {
    int n;                          // nodes
    const int* start;               // (n + 1,) into corners
    const int* corners;             // (start[n],) slots 4 e + a of the elements at the node
    const local* nodal_impulse;     // (elements, 4, 3) [N s]
    const local* scaled_gradients;  // (elements, 4, 4) scaled rotated gradients g_a, lambda / mu
    const local* twist;             // (elements, 6) E
    const local* quaternion;        // (elements, 4) unit quaternions
    own<real> b;                    // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;               // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;                // (n, 10) in, out: upper triangle of the sum of q q^T, q the elements' rotations
};

INLINE void gather_add(const CorotationalExactNodes& p, int, int k, local* sum) {
    int corner = p.corners[k];
    const local* f = p.nodal_impulse + 3 * corner;
    local g[4], q[4];
    get_row(p.scaled_gradients, corner, g);
    get_row(p.quaternion, corner >> 2, q);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    add_own(sum + 3, g);
    add_own_twist(sum + 3, g, p.twist + 6 * (corner >> 2));
    add_quaternion_product(sum + 9, q);
}

INLINE void gather_put(const CorotationalExactNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, row_at<10>(p.mean, i, m) + sum[9 + m]);
}

SUM_KERNEL(gather, CorotationalExactNodes, 19)
