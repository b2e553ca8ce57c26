// SPDX-License-Identifier: MIT
// Sums at each node the nodal impulses and diagonal blocks of its tetrahedra (kernels/hyperelastic.cuh). A gather: no two items
// write to the same place.
#include "coalesced_io.cuh"

struct GatherForces {
    int n;                // nodes
    int elements;
    const int* start;     // (n + 1,) into slots
    const int* slots;     // (start[n],) 4 e + a: corner a of element e is at the node
    const local* rows;    // (4, elements, 9) nodal impulse [N s], upper triangle of the corner's own block [kg]
    own<real> b;          // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;     // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
};

INLINE void gather_add(const GatherForces& p, int, int k, local* sum) {
    int slot = p.slots[k];
    const local* row = p.rows + 9 * ((long long)p.elements * (slot & 3) + (slot >> 2));
    for (int m = 0; m < 9; ++m) sum[m] += row[m];
}

INLINE void gather_put(const GatherForces& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
}

SUM_KERNEL(gather, GatherForces, 9)

struct GatherImpulses {
    int n;                  // nodes
    int elements;
    const int* start;       // (n + 1,) into slots
    const int* slots;       // (start[n],) 4 e + a
    const local* impulses;  // (4, elements, 3) [N s]
    own<real> b;            // (n, 3) in, out: right-hand side, world frame [N s]
};

INLINE void gather_impulses_add(const GatherImpulses& p, int, int k, local* sum) {
    int slot = p.slots[k];
    const local* f = p.impulses + 3 * ((long long)p.elements * (slot & 3) + (slot >> 2));
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
}

INLINE void gather_impulses_put(const GatherImpulses& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
}

SUM_KERNEL(gather_impulses, GatherImpulses, 3)
