// SPDX-License-Identifier: MIT
// Blocks off the diagonal of nodes that may move along some directions only (mechanics/rollers.py), before rotate_blocks.cu.
#include "mat3.cuh"

struct KeepBlocks {
    int n;               // blocks above the diagonal
    const int* row;      // (n,) node
    const int* column;   // (n,) node
    const int* limited;  // (nodes,) 1 where directions are kept
    const real* allowed; // (nodes, 6) upper triangle of S
    own<local> sums;     // (n, 9) in, out: world frame, S_row A S_column [kg]
};

INLINE local_mat3 projection_of(const real* s, int i) {
    return symmetric<local_number>(s[6 * i], s[6 * i + 1], s[6 * i + 2], s[6 * i + 3], s[6 * i + 4], s[6 * i + 5]);
}

KERNEL(keep_blocks, KeepBlocks) {
    const int row = p.row[i], column = p.column[i];
    if (p.limited[row] == 0 && p.limited[column] == 0) return;
    local_mat3 A = mul(projection_of(p.allowed, row), mul(load9(p.sums, i), projection_of(p.allowed, column)));
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, A.m[m]);
}
