// SPDX-License-Identifier: MIT
// What MJED is measured against: dW/dF and d2W/dF2 of a law as they stand, 9 and 9x9 numbers, and the blocks of an element by
// contraction with the gradients of the shape functions, the inner one shared by the blocks of a column. LAW is its text. What
// an element leaves is what kernels/hyperelastic.cu leaves.
#define WIDE
#include "hyperelastic.cuh"
#include LAW

struct GenericElements {
    int n;                    // elements
    const int* tets;          // (n, 4) nodes
    const real* x;            // (nodes, 3) positions [m]
    const real* v;            // (nodes, 3) what the tangent is applied to [m/s]
    const local* gradients;   // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* volume;      // (n,) [m3]
    const local* constants;   // (2, n) lambda, mu [Pa]
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    local h;                  // factor of the force [s]
    local* corners;           // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa [kg]
    local* edges;             // (6, n, 9) out: factor K_ab, a < b [kg]
};

// sum_l A[rk, cl] d_l
template <class T> INLINE void inner(const T (&A)[81], vec<T> d, T (&out)[27]) {
    UNROLL for (int r = 0; r < 9; ++r)
        for (int c = 0; c < 3; ++c) out[3 * r + c] = A[9 * r + 3 * c] * d.x + A[9 * r + 3 * c + 1] * d.y + A[9 * r + 3 * c + 2] * d.z;
}
// sum_k d_k M[rk, c]
template <class T> INLINE mat<T> outer(const T (&M)[27], vec<T> d) {
    mat<T> B;
    UNROLL for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) B.m[3 * r + c] = d.x * M[9 * r + c] + d.y * M[9 * r + 3 + c] + d.z * M[9 * r + 6 + c];
    return B;
}

struct Read {
    local_vec3 D[4], v[3], impulse[4];
    local_number A[81];
};

INLINE void evaluated(const GenericElements& p, index i, Read& e) {
    index tet[4];
    get_item_row(p.tets, i, tet);
    local_vec3 edges[3];
    field_edges(p.x, tet, edges);
    field_edges(p.v, tet, e.v);
    local_mat3 g, P;
    for (int k = 0; k < 9; ++k) g.m[k] = at_items(p.gradients + k * p.n, i);
    for (int k = 0; k < 3; ++k) e.D[k + 1] = row(g, k);
    set_corner_0(e.D);
    local_number volume = at_items(p.volume, i), k = volume * at_items(p.stiffness_coefficient, i), force = -p.h * volume;
    derivatives(outer3(edges[0], edges[1], edges[2], g), at_items(p.constants, i), at_items(p.constants + p.n, i), P, e.A);
    UNROLL for (int m = 0; m < 81; ++m) e.A[m] *= k;
    for (int a = 0; a < 4; ++a) e.impulse[a] = force * mul(P, e.D[a]);
}

// The blocks of the six edges; those of the corners follow by translation.
KERNEL(elements, GenericElements) {
    Read e;
    evaluated(p, i, e);
    Blocks6<local_number> B;
    UNROLL for (int b = 1; b < 4; ++b) {
        local_number M[27];
        inner(e.A, e.D[b], M);
        UNROLL for (int a = 0; a < b; ++a) B.e[a == 0 ? b - 1 : a + b] = outer(M, e.D[a]);
    }
    store_element(B, e.impulse, e.v, p.corners, p.edges, p.n, i);
}

// All sixteen blocks, as a stiffness of 12x12 has them.
KERNEL(all_blocks, GenericElements) {
    Read e;
    evaluated(p, i, e);
    local_mat3 K[4][4];
    UNROLL for (int b = 0; b < 4; ++b) {
        local_number M[27];
        inner(e.A, e.D[b], M);
        UNROLL for (int a = 0; a < 4; ++a) K[a][b] = outer(M, e.D[a]);
    }
    UNROLL for (int a = 0; a < 4; ++a) {
        local_vec3 f = e.impulse[a];
        UNROLL for (int b = 1; b < 4; ++b) f = f - mul(K[a][b], e.v[b - 1]);
        const local_number* m = K[a][a].m;
        const local_number row[9] = {f.x, f.y, f.z, m[0], m[1], m[2], m[4], m[5], m[8]};
        put_row(p.corners + 9 * (long long)p.n * a, i, p.n, row);
        UNROLL for (int b = a + 1; b < 4; ++b) put_row(p.edges + 9 * (long long)p.n * (a == 0 ? b - 1 : a + b), i, p.n, K[a][b].m);
    }
}
