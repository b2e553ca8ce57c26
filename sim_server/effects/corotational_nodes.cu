// SPDX-License-Identifier: MIT
// Sums nodal impulses, diagonal blocks and rotations of the elements at each node. A gather: no two items write to the same place.
#include "corotational_tangent.cuh"

struct CorotationalNodes {
    int n;                          // nodes
    const int* start;               // (n + 1,) into corners
    const int* corners;             // (start[n],) slots 4 e + a of the elements at the node
    const local* nodal_impulse;     // (elements, 4, 3) [N s]
    const local* scaled_gradients;  // (elements, 4, 4) scaled rotated gradients g_a, lambda / mu
    const local* quaternion;        // (elements, 4) unit quaternions
    own<real> b;                    // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;               // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;                // (n, 10) in, out: upper triangle of the sum of q q^T, q the elements' rotations
};

INLINE void gather_add(const CorotationalNodes& p, int, int k, local* sum) {
    int corner = p.corners[k];
    const local* f = p.nodal_impulse + 3 * corner;
    local g[4], q[4];
    get_row(p.scaled_gradients, corner, g);
    get_row(p.quaternion, corner >> 2, q);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    add_own(sum + 3, g);
    add_quaternion_product(sum + 9, q);
}

INLINE void gather_put(const CorotationalNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, row_at<10>(p.mean, i, m) + sum[9 + m]);
}

SUM_KERNEL(gather, CorotationalNodes, 19)

struct CorotationalForceNodes {
    int n;                       // nodes
    const int* start;            // (n + 1,) into corners
    const int* corners;          // (start[n],) slots 4 e + a of the elements at the node
    const local* nodal_impulse;  // (elements, 4, 3) [N s]
    const local* quaternion;     // (elements, 4) unit quaternions
    own<real> b;                 // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> mean;             // (n, 10) in, out: upper triangle of the sum of q q^T
};

INLINE void gather_frames_add(const CorotationalForceNodes& p, int, int k, local* sum) {
    int corner = p.corners[k];
    const local* f = p.nodal_impulse + 3 * corner;
    local q[4];
    get_row(p.quaternion, corner >> 2, q);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    add_quaternion_product(sum + 3, q);
}

INLINE void gather_frames_put(const CorotationalForceNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, row_at<10>(p.mean, i, m) + sum[3 + m]);
}

SUM_KERNEL(gather_frames, CorotationalForceNodes, 13)

struct CorotationalImpulses {
    int n;                       // nodes
    const int* start;            // (n + 1,) into corners
    const int* corners;          // (start[n],)
    const local* nodal_impulse;  // (elements, 4, 3) [N s]
    own<real> b;                 // (n, 3) in, out [N s]
};

INLINE void gather_impulses_add(const CorotationalImpulses& p, int, int k, local* sum) {
    const local* f = p.nodal_impulse + 3 * p.corners[k];
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
}

INLINE void gather_impulses_put(const CorotationalImpulses& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
}

SUM_KERNEL(gather_impulses, CorotationalImpulses, 3)
