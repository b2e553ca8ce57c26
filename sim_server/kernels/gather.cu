// SPDX-License-Identifier: MIT
// Collects at each node what its elements left for it: a gather, so that no two items write one place.
#include "mat3.cuh"

struct Gather {
    int n;                 // nodes
    const int* start;      // (n + 1,) into corners
    const int* corners;    // (start[n],) slots 4 e + a of the elements at the node
    const real* push;      // (elements, 4, 3) [N s]
    const real* rotation;  // (elements, 3, 3)
    real* b;               // (n, 3) in, out: right-hand side, world frame [N s]
    real* mean;            // (n, 3, 3) in, out: sum of the elements' rotations
};

INLINE void gather_add(const Gather& p, int, int k, real* sum) {
    int corner = p.corners[k];
    const real *f = p.push + 3 * corner, *r = p.rotation + 9 * (corner >> 2);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    for (int m = 0; m < 9; ++m) sum[3 + m] += r[m];
}

INLINE void gather_put(const Gather& p, int i, const real* sum) {
    for (int m = 0; m < 3; ++m) p.b[3 * i + m] += sum[m];
    for (int m = 0; m < 9; ++m) p.mean[9 * i + m] += sum[3 + m];
}

SUM_KERNEL(gather, Gather, 12)
