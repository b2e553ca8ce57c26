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

KERNEL(gather, Gather) {
    vec3 b = load3(p.b, i);
    mat3 sum = load9(p.mean, i);
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) {
        int corner = p.corners[k];
        b = b + load3(p.push, corner);
        const real* r = p.rotation + 9 * (corner >> 2);
        for (int m = 0; m < 9; ++m) sum.m[m] += r[m];
    }
    store3(p.b, i, b);
    store9(p.mean, i, sum);
}
