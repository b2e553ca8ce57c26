// SPDX-License-Identifier: MIT
// Rotations of nodes by shape matching (formulas: shape_matching.py), for bodies whose elements have none of their own.
#include "mat3.cuh"
#include "coalesced_io.cuh"

struct Match {
    int n;                 // nodes
    const int* start;      // (n + 1,) into neighbours; none: the node keeps the mean that it has
    const int* neighbour;  // (start[n],) nodes
    const local* arm;      // (start[n], 3) scaled m_j (X_j - X_c)
    const real* x;         // (n, 3) positions [m]
    own<local> mean;       // (n, 10) out: products of quaternions whose sum of rotations is A
};

// A = sum_j m_j (x_j - x_c) (X_j - X_c)^T. x_i may replace x_c: the arms of a node's neighbours and its own sum to zero.
INLINE void match_add(const Match& p, int i, int k, local* sum) {
    const real *there = p.x + 3 * p.neighbour[k], *here = p.x + 3 * i;
    const local* arm = p.arm + 3 * k;
    for (int m = 0; m < 3; ++m) {
        local u = (local)(there[m] - here[m]);
        for (int c = 0; c < 3; ++c) sum[3 * m + c] += u * arm[c];
    }
}

// Stores the matrix in the ten numbers from which nodes.cu makes a sum of rotations: they can represent any matrix.
INLINE void match_put(const Match& p, int i, const local* a) {
    if (p.start[i] == p.start[i + 1]) return;
    const local quarter = (local)0.25, half = (local)0.5, w = quarter * (a[0] + a[4] + a[8]);
    const local mean[10] = {w, quarter * (a[7] - a[5]), quarter * (a[2] - a[6]), quarter * (a[3] - a[1]),
                            half * a[0] - w, quarter * (a[1] + a[3]), quarter * (a[2] + a[6]),
                            half * a[4] - w, quarter * (a[5] + a[7]), half * a[8] - w};
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, mean[m]);
}

SUM_KERNEL(match, Match, 9)
