// SPDX-License-Identifier: MIT
// Shared by materials that remember strains in the turning frame of a tetrahedron (formulas: sim_server/effects/_history.py).
#pragma once
#include "corotational.cuh"
#include "hyperelastic.cuh"

template <class T> struct symmetric6 { T m[6]; };  // entries 00, 01, 02, 11, 12, 22

template <class T> INLINE T trace(const symmetric6<T>& a) { return a.m[0] + a.m[3] + a.m[5]; }
template <class T> INLINE mat<T> whole(const symmetric6<T>& a) { return symmetric(a.m[0], a.m[1], a.m[2], a.m[3], a.m[4], a.m[5]); }
template <class T> INLINE void add_to_diagonal(symmetric6<T>& a, T d) { a.m[0] += d; a.m[3] += d; a.m[5] += d; }
template <class T> INLINE T contraction(const symmetric6<T>& a, const symmetric6<T>& b) {
    return a.m[0] * b.m[0] + a.m[3] * b.m[3] + a.m[5] * b.m[5] + 2 * (a.m[1] * b.m[1] + a.m[2] * b.m[2] + a.m[4] * b.m[4]);
}
template <class T> INLINE symmetric6<T> deviator(symmetric6<T> a) {
    add_to_diagonal(a, -(entry<T>)(1.0 / 3) * trace(a));
    return a;
}
INLINE symmetric6<local_number> symmetric_at(const local* a, int n, index i) {
    symmetric6<local_number> s;
    UNROLL for (int k = 0; k < 6; ++k) s.m[k] = at_items(a + k * (long long)n, i);
    return s;
}
INLINE void put_symmetric(local* a, int n, index i, const symmetric6<local_number>& s) {
    UNROLL for (int k = 0; k < 6; ++k) put(a + k * (long long)n, i, s.m[k]);
}

// An element as it stands: its rotation R, stretch S = R^T F and strain S - I.
template <class T> struct TurnedElement {
    mat<T> gradients, R, S;  // rest gradients of corners 1, 2, 3 in rows [1/m]
    symmetric6<T> strain;
};

// tet: its nodes.
template <class P> INLINE TurnedElement<local_number> turned_element_at(const P& p, index i, index (&tet)[4]) {
    TurnedElement<local_number> e;
    get_item_row(p.tets, i, tet);
    e.gradients = rest_gradients(p.gradients, p.n, i);
    local_mat3 F = gradient(p.x, tet, e.gradients);
    e.R = nearest_rotation(F);
    e.S = mul(transposed(e.R), F);
    const local half = (local)0.5;
    const local_number* s = e.S.m;
    e.strain = {{s[0] - 1, half * (s[1] + s[3]), half * (s[2] + s[6]), s[4] - 1, half * (s[5] + s[7]), s[8] - 1}};
    return e;
}

// R (stress + A): the first Piola-Kirchhoff stress whose work is stress : dS. The skew A, A S + S A = S stress - stress S, takes away the
// torque that a stress has which is not coaxial with S. Near S = 0 (sums of two stretches below a half) it is less.
template <class T> INLINE mat<T> without_torque(const TurnedElement<T>& e, const symmetric6<T>& stress) {
    mat<T> N = whole(stress), M = mul(e.S, N);
    vec<T> c = {M.m[7] - M.m[5], M.m[2] - M.m[6], M.m[3] - M.m[1]};
    const symmetric6<T>& s = e.strain;
    T xx = 2 + s.m[3] + s.m[5], yy = 2 + s.m[0] + s.m[5], zz = 2 + s.m[0] + s.m[3], xy = -s.m[1], xz = -s.m[2], yz = -s.m[4];
    T A = yy * zz - yz * yz, B = yz * xz - xy * zz, C = xy * yz - yy * xz;
    T inverse = 1 / larger(xx * A + xy * B + xz * C, T{} + (entry<T>)0.125);
    vec<T> a = inverse * vec<T>{A * c.x + B * c.y + C * c.z, B * c.x + (xx * zz - xz * xz) * c.y + (xy * xz - xx * yz) * c.z,
                                C * c.x + (xy * xz - xx * yz) * c.y + (xx * yy - xy * xy) * c.z};
    N.m[1] -= a.z; N.m[2] += a.y; N.m[3] += a.z; N.m[5] -= a.x; N.m[6] -= a.y; N.m[7] += a.x;
    return mul(e.R, N);
}

// Rest gradients of all corners, in the frame of the world.
template <class T> INLINE void world_gradients(const TurnedElement<T>& e, vec<T> (&D)[4]) {
    UNROLL for (int k = 0; k < 3; ++k) D[k + 1] = mul(e.R, row(e.gradients, k));
    set_corner_0(D);
}

// Impulses -P grad N_a.
template <class T> INLINE void impulses_of(const TurnedElement<T>& e, const mat<T>& P, vec<T> (&impulse)[4]) {
    UNROLL for (int k = 0; k < 3; ++k) impulse[k + 1] = -mul(P, row(e.gradients, k));
    set_corner_0(impulse);
}

// Blocks of the edges of the stiffness of stress = 2 mu strain + lambda tr(strain) I.
template <class T> INLINE Blocks6<T> isotropic_blocks(const vec<T> (&D)[4], T lambda, T mu) {
    Blocks6<T> B;
    UNROLL for (int e = 0; e < 6; ++e) {
        vec<T> a = D[edge_first(e)], b = D[edge_second(e)];
        B.e[e] = mat<T>{};
        add_identity(B.e[e], mu * dot(a, b));
        add_outer(B.e[e], mu * b, a);
        add_outer(B.e[e], lambda * a, b);
    }
    return B;
}

// Whether the body of an element may move: a body that was frozen has no free node.
template <class P> INLINE auto is_live(const P& p, index i) { return (local_number)at(p.free, at(p.watched, i)) > 0; }
