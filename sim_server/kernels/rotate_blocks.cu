// SPDX-License-Identifier: MIT
// Rotates the blocks off the diagonal into the material frame, A' = R^T A R; nodes.cu rotates those on it. In this frame the
// factor of the matrix of time t is the warped factor R_s R_t^T P^-1 R_t R_s^T of time s (Courtecuisse et al. 2010, eq. 12 and
// 13), at no cost per iteration.
#include "mat3.cuh"
#include "coalesced_io.cuh"

struct RotateBlocks {
    int n;                  // blocks above the diagonal
    const int* row;         // (n,) node
    const int* column;      // (n,) node, above row
    const int* upper;       // (n,) place of the block in the full pattern
    const int* lower;       // (n,) place of its transpose
    own<local> sums;        // (n, 9) world frame [kg]
    const local* rotation;  // (nodes, 3, 3)
    real* values;           // (blocks, 3, 3) out: A' = R^T A R, block CSR, both triangles [kg]
};

KERNEL(rotate_blocks, RotateBlocks) {
    local_mat3 A = mul(transposed(load9(p.rotation, p.row[i])), mul(load9(p.sums, i), load9(p.rotation, p.column[i])));
    put_block(p.values, p.upper[i], i, p.n, as<real>(A).m);
    put_block(p.values, p.lower[i], i, p.n, as<real>(transposed(A)).m);
}
