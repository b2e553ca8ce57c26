// SPDX-License-Identifier: MIT
// Takes the rotations of removed elements out of the sums at their nodes (cutting.py): they say nothing of how the rest turns.
#include "corotational_tangent.cuh"

struct CutRotations {
    int n;                    // nodes
    const int* start;         // (n + 1,) into corners
    const int* corners;       // (start[n],) slots 4 e + a of the elements at the node
    const local* present;     // (elements,) 0 where an element was removed
    const local* quaternion;  // (elements, 4) unit quaternions
    const real* at_rest;      // (n,) 1 at nodes without elements, whose frame may be any
    own<local> mean;          // (n, 10) in, out: upper triangle of the sum of q q^T, q the elements' rotations
};

INLINE void leave_out_add(const CutRotations& p, int, int k, local* sum) {
    const int element = p.corners[k] >> 2;
    if (p.present[element] != 0) return;
    local q[4];
    get_row(p.quaternion, element, q);
    add_quaternion_product(sum, q);
}

INLINE void leave_out_put(const CutRotations& p, int i, const local* sum) {
    if (p.at_rest[i] != 0) return;
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, row_at<10>(p.mean, i, m) - sum[m]);
}

SUM_KERNEL(leave_out, CutRotations, 10)
