// SPDX-License-Identifier: MIT
// The system matrix in the material frame, A' = R^T A R: solved there, the factor of A' made at time t *is* the warped
// factor R_s R_t^T P^-1 R_t R_s^T at time s (Courtecuisse et al. 2010, eq. 12 and 13), at no cost per iteration.
#include "mat3.cuh"

struct Assemble {
    int n;                 // blocks on and above the diagonal
    const int* row;        // (n,) node
    const int* column;     // (n,) node, not below row
    const int* upper;      // (n,) place of the block in the full pattern
    const int* lower;      // (n,) place of its transpose
    const real* free;      // (nodes,) 1, or 0 at fixed nodes
    const real* diagonal;  // (nodes,) [kg]
    const real* sums;      // (n, 3, 3) world frame [kg]
    const real* rotation;  // (nodes, 3, 3)
    real* values;          // (blocks, 3, 3) out: A' = R^T A R, block CSR, both triangles [kg]
};

KERNEL(assemble, Assemble) {
    int r = p.row[i], c = p.column[i];
    mat3 K = load9(p.sums, i);
    if (r == c) {
        real d = p.diagonal[r];
        K.m[0] += d; K.m[4] += d; K.m[8] += d;
    }
    mat3 A = mul(transposed(load9(p.rotation, r)), mul(K, load9(p.rotation, c)));
    if (r != c) {
        store9(p.values, p.lower[i], transposed(A));
    } else if (p.free[r] == 0) {
        A = {{1, 0, 0, 0, 1, 0, 0, 0, 1}};
    } else {  // symmetric to the last bit
        A.m[1] = A.m[3] = (real)0.5 * (A.m[1] + A.m[3]);
        A.m[2] = A.m[6] = (real)0.5 * (A.m[2] + A.m[6]);
        A.m[5] = A.m[7] = (real)0.5 * (A.m[5] + A.m[7]);
    }
    store9(p.values, p.upper[i], A);
}
