// SPDX-License-Identifier: MIT
// Shared by the laws of hyperelastic tetrahedra (formulas: sim_server/effects/_hyperelastic.py).
#pragma once
#include "eigen9.cuh"
#include "svd3.cuh"
#include "coalesced_io.cuh"

template <class T> INLINE mat<T> mul_transposed(const mat<T>& a, const mat<T>& b) { return mul(a, transposed(b)); }

// --- an element ------------------------------------------------------------------------------------------------------------

// The six edges (i, j), i < j: 01, 02, 03, 12, 13, 23.
INLINE constexpr int edge_first(int e) { return e < 3 ? 0 : e < 5 ? 1 : 2; }
INLINE constexpr int edge_second(int e) { return e < 3 ? e + 1 : e < 5 ? e - 1 : 3; }

template <class T> struct Tetrahedron {
    mat<T> F;        // deformation gradient
    vec<T> D[4];     // rest gradients of the shape functions [1/m]
    vec<T> g[4];     // F D_i
    vec<T> area[4];  // gradients of J = det F: cof(F) D_i [1/m]
    vec<T> q[3];     // edges from corner 0, over 6 V [1/m2]
    T J;
};

// The value of corner 0: those of the four corners sum to zero.
template <class T> INLINE void set_corner_0(vec<T> (&u)[4]) { u[0] = -(u[1] + u[2] + u[3]); }

// edges: from corner 0 now; gradients (9, n): rest gradients of corners 1, 2, 3.
template <class T> INLINE Tetrahedron<T> tetrahedron(const vec<T> (&edges)[3], const local* gradients, int n, index i) {
    Tetrahedron<T> t;
    mat<T> rows;
    for (int k = 0; k < 9; ++k) rows.m[k] = at_items(gradients + k * n, i);
    UNROLL for (int k = 0; k < 3; ++k) t.D[k + 1] = row(rows, k);
    set_corner_0(t.D);
    t.F = outer3(edges[0], edges[1], edges[2], rows);
    T inverse = dot(t.D[1], cross(t.D[2], t.D[3]));  // 1 / (6 V)
    UNROLL for (int k = 0; k < 3; ++k) t.q[k] = inverse * edges[k];
    t.area[1] = cross(t.q[1], edges[2]);
    t.area[2] = cross(t.q[2], edges[0]);
    t.area[3] = cross(t.q[0], edges[1]);
    set_corner_0(t.area);
    t.J = dot(t.area[1], edges[0]);
    UNROLL for (int k = 1; k < 4; ++k) t.g[k] = mul(t.F, t.D[k]);
    set_corner_0(t.g);
    return t;
}

// Edges from corner 0 of a nodal field, their differences in the field's precision.
template <class T> INLINE void field_edges(const real* field, const index (&tet)[4], vec<T> (&edges)[3]) {
    vec3 u = load3(field, tet[0]);
    UNROLL for (int k = 0; k < 3; ++k) edges[k] = as<T>(load3(field, tet[k + 1]) - u);
}

// Element i of a kernel's parameters as it stands now; tet: its nodes.
template <class T = local_number, class P> INLINE Tetrahedron<T> element_at(const P& p, index i, index (&tet)[4]) {
    get_item_row(p.tets, i, tet);
    vec<T> edges[3];
    field_edges(p.x, tet, edges);
    return tetrahedron(edges, p.gradients, p.n, i);
}

// Its constants of the law, (N, n) one after another.
template <int N, class P, class T> INLINE void constants_at(const P& p, index i, T (&c)[N]) {
    for (int k = 0; k < N; ++k) c[k] = at_items(p.constants + k * p.n, i);
}

// F (D_i x D_j) of an edge, from the current edges: no products.
template <class T> INLINE vec<T> opposite(const vec<T> (&q)[3], int e) {
    return e == 0 ? q[2] - q[1] : e == 1 ? q[0] - q[2] : e == 2 ? q[1] - q[0] : e == 3 ? q[2] : e == 4 ? -q[1] : q[0];
}

// --- sums of blocks --------------------------------------------------------------------------------------------------------

template <class T> INLINE void add_outer(mat<T>& B, vec<T> a, vec<T> b) {
    B.m[0] += a.x * b.x; B.m[1] += a.x * b.y; B.m[2] += a.x * b.z;
    B.m[3] += a.y * b.x; B.m[4] += a.y * b.y; B.m[5] += a.y * b.z;
    B.m[6] += a.z * b.x; B.m[7] += a.z * b.y; B.m[8] += a.z * b.z;
}
template <class T> INLINE void add_identity(mat<T>& B, T d) { B.m[0] += d; B.m[4] += d; B.m[8] += d; }
// B -= [c]x, the matrix of v -> c x v
template <class T> INLINE void subtract_cross(mat<T>& B, vec<T> c) {
    B.m[1] += c.z; B.m[2] -= c.y; B.m[3] -= c.z; B.m[5] += c.x; B.m[6] += c.y; B.m[7] -= c.x;
}

template <class T> struct Blocks6 { mat<T> e[6]; };  // of the edges

// Entry (r, c), r >= c, of the 9x9 stiffness of corners 1, 2, 3: the fourth corner follows by translation.
template <class T> INLINE T corner_entry(const Blocks6<T>& B, int r, int c) {
    int a = r / 3 + 1, b = c / 3 + 1, k = 3 * (r % 3) + c % 3, t = 3 * (c % 3) + r % 3;
    if (a == b) {  // B_aa = - sum of the edges at a
        int u = a == 1 ? 2 : 1, v = a == 3 ? 2 : 3;
        T sum = B.e[a - 1].m[t];  // B_0a transposed
        sum += u > a ? B.e[a + u].m[k] : B.e[a + u].m[t];
        sum += v > a ? B.e[a + v].m[k] : B.e[a + v].m[t];
        return -sum;
    }
    return B.e[a + b].m[t];  // a > b: the transpose of B_ba
}

// Whether the element's stiffness is positive semi-definite to rounding: no pivot of L D L^T is negative once rounding's share
// of the trace stands on the diagonal. It is so where d2W/dF2 is, since one is the other in another basis.
template <class T> INLINE auto indefinite(const Blocks6<T>& B) {
    T a[45], sum = T{};
    UNROLL for (int r = 0; r < 9; ++r) {
        UNROLL for (int c = 0; c <= r; ++c) a[r * (r + 1) / 2 + c] = corner_entry(B, r, c);
        sum += a[r * (r + 1) / 2 + r];
    }
    const T little = (single<T> ? (entry<T>)1e-6 : (entry<T>)1e-12) * sum;
    T least = sum;
    UNROLL for (int k = 0; k < 9; ++k) {
        T pivot = a[k * (k + 1) / 2 + k] + little, inverse = 1 / pivot;
        least = smaller(least, pivot);
        UNROLL for (int r = k + 1; r < 9; ++r) {
            T l = a[r * (r + 1) / 2 + k] * inverse;
            UNROLL for (int c = k + 1; c <= r; ++c) a[r * (r + 1) / 2 + c] -= l * a[c * (c + 1) / 2 + k];
        }
    }
    return !(least > 0);
}

// --- principal stretches ---------------------------------------------------------------------------------------------------

// d2W/dF2 of an isotropic law in the frame of the principal stretches (Smith, de Goes, Kim 2019): the eigenvalues of the
// twists and flips in the plane across axis k, and the matrix of the stretches, 00, 01, 02, 11, 12, 22.
template <class T> struct Modes { T twist[3], flip[3], stretch[6]; };

enum Projection { NONE = 0, CLAMP = 1, ABSOLUTE = 2, EXCESS = 3 };

// Whether the symmetric matrix 00, 01, 02, 11, 12, 22 has a negative eigenvalue, to rounding.
template <class T> INLINE auto indefinite3(const T (&a)[6]) {
    const T little = (single<T> ? (entry<T>)1e-6 : (entry<T>)1e-14) * (magnitude(a[0]) + magnitude(a[3]) + magnitude(a[5]));
    T first = a[0] + little, l = a[1] / first, r = a[2] / first, second = a[3] + little - l * a[1], across = a[4] - l * a[2];
    return !(first > 0 && second > 0 && second * (a[5] + little - r * a[2]) > across * across);
}

// What a projection adds to an eigenvalue.
template <class T> INLINE T lifted(T eigenvalue, int projection) {
    return eigenvalue < 0 ? (projection == CLAMP ? -eigenvalue : -2 * eigenvalue) : T{};
}

// ... to that of a twist or a flip, the other one given. EXCESS: the material's own stiffness is their mean; compression takes that
// much from one and gives it to the other, and only what it takes beyond the mean is made positive.
template <class T> INLINE T lifted_twist(T eigenvalue, T other, int projection) {
    if (projection != EXCESS) return lifted(eigenvalue, projection);
    const entry<T> half = 0.5;
    T mean = half * (eigenvalue + other), own = mean > 0 ? mean : T{}, beyond = -eigenvalue - own;
    return eigenvalue < 0 ? -eigenvalue + (beyond > 0 ? beyond : T{}) : T{};
}

// What it adds to the matrix of the stretches: sum of share_k v_k v_k^T; nothing where it stays as it is.
template <class T> struct Lift3 { T share[3]; vec<T> v[3]; };

template <class T, class M> INLINE Lift3<T> stretch_lift(const T (&stretch)[6], int projection, M where) {
    const T one = T{} + 1;
    Lift3<T> lift = {{T{}, T{}, T{}}, {{one, T{}, T{}}, {T{}, one, T{}}, {T{}, T{}, one}}};
    auto wrong = where && indefinite3(stretch);
    if (!any(wrong)) return lift;
    T a[6];
    UNROLL for (int k = 0; k < 6; ++k) a[k] = stretch[k];
    eigen3(a, lift.v);
    lift.share[0] = wrong ? lifted(a[0], projection) : T{};
    lift.share[1] = wrong ? lifted(a[3], projection) : T{};
    lift.share[2] = wrong ? lifted(a[5], projection) : T{};
    return lift;
}

// All modes projected.
template <class T> INLINE void project(Modes<T>& m, int projection) {
    if (projection == NONE) return;
    UNROLL for (int k = 0; k < 3; ++k) {
        T twist = m.twist[k], flip = m.flip[k];
        m.twist[k] += lifted_twist(twist, flip, projection);
        m.flip[k] += lifted_twist(flip, twist, projection);
    }
    Lift3<T> lift = stretch_lift(m.stretch, projection, m.stretch[0] == m.stretch[0]);
    UNROLL for (int k = 0; k < 3; ++k) {
        vec<T> u = lift.v[k], w = lift.share[k] * u;
        m.stretch[0] += w.x * u.x; m.stretch[1] += w.x * u.y; m.stretch[2] += w.x * u.z;
        m.stretch[3] += w.y * u.y; m.stretch[4] += w.y * u.z; m.stretch[5] += w.z * u.z;
    }
}

// B_ij += share y_i y_j^T: a mode of d2W/dF2 with y_i its matrix times D_i.
template <class T> INLINE void add_mode(Blocks6<T>& B, T share, vec<T> (&y)[4]) {
    set_corner_0(y);
    vec<T> w[3] = {share * y[0], share * y[1], share * y[2]};
    UNROLL for (int e = 0; e < 6; ++e) add_outer(B.e[e], w[edge_first(e)], y[edge_second(e)]);
}

// k d2W/dF2 projected: what its negative modes lack is added, where it is so.
template <class T, class M>
INLINE void lift_modes(const Principal<T>& p, const Modes<T>& m, int projection, M where, T k, const vec<T> (&D)[4], Blocks6<T>& B) {
    const entry<T> half = 0.5;
    vec<T> y[4];
    UNROLL for (int a = 0; a < 3; ++a) {
        const vec<T> &u = p.u[(a + 1) % 3], &w = p.u[(a + 2) % 3], &r = p.v[(a + 1) % 3], &q = p.v[(a + 2) % 3];
        T twist = where ? lifted_twist(m.twist[a], m.flip[a], projection) : T{};
        T flip = where ? lifted_twist(m.flip[a], m.twist[a], projection) : T{};
        if (any(twist > 0)) {
            UNROLL for (int i = 1; i < 4; ++i) y[i] = dot(q, D[i]) * u - dot(r, D[i]) * w;
            add_mode(B, half * k * twist, y);
        }
        if (any(flip > 0)) {
            UNROLL for (int i = 1; i < 4; ++i) y[i] = dot(q, D[i]) * u + dot(r, D[i]) * w;
            add_mode(B, half * k * flip, y);
        }
    }
    Lift3<T> lift = stretch_lift(m.stretch, projection, where);
    UNROLL for (int a = 0; a < 3; ++a) {
        if (!any(lift.share[a] > 0)) continue;
        const vec<T>& l = lift.v[a];
        UNROLL for (int i = 1; i < 4; ++i)
            y[i] = (l.x * dot(p.v[0], D[i])) * p.u[0] + (l.y * dot(p.v[1], D[i])) * p.u[1] + (l.z * dot(p.v[2], D[i])) * p.u[2];
        add_mode(B, k * lift.share[a], y);
    }
}

// The edge blocks of k d2W/dF2, from its modes.
template <class T>
INLINE void principal_edges(const Principal<T>& p, const Modes<T>& m, T k, const vec<T> (&D)[4], Blocks6<T>& B) {
    vec<T> d[4];  // V^T D_i
    UNROLL for (int i = 1; i < 4; ++i) d[i] = {dot(p.v[0], D[i]), dot(p.v[1], D[i]), dot(p.v[2], D[i])};
    set_corner_0(d);
    mat<T> U = {{p.u[0].x, p.u[1].x, p.u[2].x, p.u[0].y, p.u[1].y, p.u[2].y, p.u[0].z, p.u[1].z, p.u[2].z}};
    T plus[3], minus[3];
    const entry<T> half = 0.5;
    UNROLL for (int a = 0; a < 3; ++a) {
        plus[a] = half * k * (m.flip[a] + m.twist[a]);
        minus[a] = half * k * (m.flip[a] - m.twist[a]);
    }
    T h[6];
    UNROLL for (int a = 0; a < 6; ++a) h[a] = k * m.stretch[a];
    UNROLL for (int e = 0; e < 6; ++e) {
        vec<T> i = d[edge_first(e)], j = d[edge_second(e)];
        T xx = i.x * j.x, yy = i.y * j.y, zz = i.z * j.z;
        mat<T> C = {{h[0] * xx + plus[2] * yy + plus[1] * zz, h[1] * i.x * j.y + minus[2] * i.y * j.x,
                     h[2] * i.x * j.z + minus[1] * i.z * j.x, h[1] * i.y * j.x + minus[2] * i.x * j.y,
                     h[3] * yy + plus[2] * xx + plus[0] * zz, h[4] * i.y * j.z + minus[0] * i.z * j.y,
                     h[2] * i.z * j.x + minus[1] * i.x * j.z, h[4] * i.z * j.y + minus[0] * i.y * j.z,
                     h[5] * zz + plus[1] * xx + plus[0] * yy}};
        B.e[e] = mul_transposed(mul(U, C), U);
    }
}

// --- any law: the eigensystem of 9x9 ------------------------------------------------------------------------------------------

// Blocks m (3, 3 of corners 1, 2, 3) = (X (x) I) K (X (x) I)^T
template <class T> INLINE void congruent(const mat<T>& X, T (&K)[9][9]) {
    for (int c = 0; c < 9; ++c) {
        for (int d = 0; d < 3; ++d) {
            T u = K[d][c], v = K[3 + d][c], w = K[6 + d][c];
            for (int k = 0; k < 3; ++k) K[3 * k + d][c] = X.m[3 * k] * u + X.m[3 * k + 1] * v + X.m[3 * k + 2] * w;
        }
    }
    for (int r = 0; r < 9; ++r) {
        for (int d = 0; d < 3; ++d) {
            T u = K[r][d], v = K[r][3 + d], w = K[r][6 + d];
            for (int k = 0; k < 3; ++k) K[r][3 * k + d] = X.m[3 * k] * u + X.m[3 * k + 1] * v + X.m[3 * k + 2] * w;
        }
    }
}

// The edges with d2W/dF2 projected: to it from the stiffness of three corners by the rest edges; what its negative modes lack is
// added, where it is so.
template <class T, class M> OUT_OF_LINE void project_edges(const vec<T> (&D)[4], int projection, const M& where, Blocks6<T>& B) {
    T K[9][9];
    for (int r = 0; r < 9; ++r)
        for (int c = 0; c < 9; ++c) K[r][c] = r >= c ? corner_entry(B, r, c) : corner_entry(B, c, r);
    vec<T> x = cross(D[2], D[3]), y = cross(D[3], D[1]), z = cross(D[1], D[2]);
    T det = dot(D[1], x);
    x = (1 / det) * x; y = (1 / det) * y; z = (1 / det) * z;
    congruent(mat<T>{{x.x, y.x, z.x, x.y, y.y, z.y, x.z, y.z, z.z}}, K);
    Eigen9<T> eigen;
    eigen9(K, eigen);
    for (int k = 0; k < 9; ++k) {
        T share = where ? lifted(eigen.value[k], projection) : T{};
        if (!any(share > 0)) continue;
        const T (&v)[9] = eigen.vector[k];
        vec<T> mode[4];
        for (int i = 1; i < 4; ++i)
            mode[i] = D[i].x * vec<T>{v[0], v[1], v[2]} + D[i].y * vec<T>{v[3], v[4], v[5]} + D[i].z * vec<T>{v[6], v[7], v[8]};
        add_mode(B, share, mode);
    }
}

// --- functions of J that laws have, and what becomes of them below a floor ---------------------------------------------------

// f, f', f'' at J. Below `floor` > 0: the parabola that f has at the floor, so that W stays twice continuously differentiable
// and is defined for any J; floor = 0 leaves J <= 0 undefined.
template <class T> struct Jet { T f, d, dd; };

template <class T> INLINE Jet<T> below(Jet<T> at_floor, T J, T floor) {
    T x = J > floor ? T{} : J - floor;
    const entry<T> half = 0.5;
    return {at_floor.f + x * (at_floor.d + half * x * at_floor.dd), at_floor.d + x * at_floor.dd, at_floor.dd};
}

template <class T> INLINE Jet<T> logarithm(T J, T floor) {
    T base = larger(J, floor), inverse = 1 / base;
    return below({log(base), inverse, -inverse * inverse}, J, floor);
}

// bulk/2 ln^2 J
template <class T> INLINE Jet<T> half_squared_logarithm(T bulk, T J, T floor) {
    Jet<T> L = logarithm(J, floor);
    return {(entry<T>)0.5 * bulk * L.f * L.f, bulk * L.f * L.d, bulk * (L.d * L.d + L.f * L.dd)};
}

// Powers J^(-2 i / 3), as isochoric invariants have them.
template <class T> struct Thirds {
    T root, inverse, J, floor;  // base^(-2/3) and 1 / base, base = max(J, floor)
    INLINE_MEMBER Jet<T> minus(int i) const {
        T value = root;
        UNROLL for (int k = 1; k < i; ++k) value = value * root;
        const entry<T> p = (entry<T>)(-2. * i / 3);
        T d = p * value * inverse;
        return below({value, d, (p - 1) * d * inverse}, J, floor);
    }
};

template <class T> INLINE Thirds<T> thirds(T J, T floor) {
    T base = larger(J, floor), r = 1 / cbrt(base);
    return {r * r, 1 / base, J, floor};
}

// --- output of an element for nodes and blocks ------------------------------------------------------------------------------

// Records the first time at which the element was refused and its J there; refused (n, 2) begins with (-1, 0).
#ifdef __CUDACC_RTC__
INLINE void note_refusal(bool here, double* refused, index i, double now, local_number J) {
    if (here && refused[2 * i] < 0) {
        refused[2 * i + 1] = J;
        refused[2 * i] = now;
    }
}
#else
template <class M, class T> INLINE void note_refusal(M here, double* refused, index i, double now, T J) {
    if (!any(here)) return;
    for (int k = 0; k < LANES; ++k) {
        double* mine = refused + 2 * lane(i, k);
        if (lane(here, k) && mine[0] < 0) { mine[0] = now; mine[1] = (double)lane(J, k); }
    }
}
#endif

template <class T> INLINE T no_number() {
    T zero = T{};
    return zero / zero;
}

// A refused element has zero stiffness and a force of NaN: the solver reports it, and the matrix stays finite.
template <class M, class T> INLINE void refuse(M here, Blocks6<T>& B, vec<T> (&impulse)[4]) {
    const T zero = T{}, nan = no_number<T>();
    UNROLL for (int e = 0; e < 6; ++e)
        for (int a = 0; a < 9; ++a) B.e[e].m[a] = here ? zero : B.e[e].m[a];
    UNROLL for (int a = 0; a < 4; ++a) impulse[a] = {here ? nan : impulse[a].x, here ? nan : impulse[a].y, here ? nan : impulse[a].z};
}

// Stores the nodal impulses f_i = impulse_i - sum_j B_ij v_j, impulse_i = -h grad_i, each with the upper triangle of B_ii in a row
// of nine, one corner after another; and the blocks of the edges, one edge after another. v: differences from corner 0 of the
// field that the tangent is applied to.
template <class T>
INLINE void store_element(const Blocks6<T>& B, const vec<T> (&impulse)[4], const vec<T> (&v)[3], local* corners, local* edges, int n,
                          index i) {
    vec<T> f[4];
    T own[4][6];
    UNROLL for (int a = 0; a < 4; ++a) {
        f[a] = impulse[a];
        UNROLL for (int k = 0; k < 6; ++k) own[a][k] = T{};
    }
    UNROLL for (int e = 0; e < 6; ++e) {
        const int a = edge_first(e), b = edge_second(e);
        const T* m = B.e[e].m;
        vec<T> w = a == 0 ? v[b - 1] : v[b - 1] - v[a > 0 ? a - 1 : 0];
        f[a] = f[a] - mul(B.e[e], w);
        f[b] = f[b] + mul(transposed(B.e[e]), w);
        const T half = T{} + (entry<T>)0.5;
        T xy = half * (m[1] + m[3]), xz = half * (m[2] + m[6]), yz = half * (m[5] + m[7]);  // their sums are symmetric
        UNROLL for (int k = 0; k < 2; ++k) {
            T* s = own[k ? b : a];
            s[0] -= m[0]; s[1] -= xy; s[2] -= xz; s[3] -= m[4]; s[4] -= yz; s[5] -= m[8];
        }
        put_row(edges + 9 * (long long)n * e, i, n, B.e[e].m);
    }
    UNROLL for (int a = 0; a < 4; ++a) {
        const T row[9] = {f[a].x, f[a].y, f[a].z, own[a][0], own[a][1], own[a][2], own[a][3], own[a][4], own[a][5]};
        put_row(corners + 9 * (long long)n * a, i, n, row);
    }
}
