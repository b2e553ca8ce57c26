// SPDX-License-Identifier: MIT
// Singular values and vectors of 3x3 matrices.
#pragma once
#include "eigen3.cuh"

// F = U diag(s) V^T with rotations U and V, s1 >= s2 >= |s3|; s3 has the sign of det F (Irving, Teran, Fedkiw 2004).
template <class T> struct Principal {
    vec<T> u[3], v[3];  // columns
    T s[3];
};

template <class M, class T> INLINE vec<T> chosen(M first, vec<T> a, vec<T> b) {
    return {first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
}

// One rotation of Jacobi's method by columns (Hestenes 1958): makes a and b orthogonal, columns of F V, and turns p and q, those
// of V, with them.
template <class T, class M> INLINE void part(vec<T>& a, vec<T>& b, vec<T>& p, vec<T>& q, M settled) {
    const T tiny = T{} + (single<T> ? (entry<T>)1e-37 : (entry<T>)1e-300);
    T d = dot(b, b) - dot(a, a), ab = dot(a, b), size = magnitude(d) + sqrt(d * d + 4 * ab * ab) + tiny;
    T t = (d < 0 ? -2 * ab : 2 * ab) / size;
    t = settled ? T{} : t;  // and its neighbours in a vector go on without it
    T c = inverse_root(1 + t * t), s = t * c;
    vec<T> x = a, y = p;
    a = c * x - s * b;
    b = s * x + c * b;
    p = c * y - s * q;
    q = s * y + c * q;
}

// Swaps where `where` holds; the sign keeps V a rotation.
template <class T, class M> INLINE void swap(M where, vec<T>& a, vec<T>& b, vec<T>& p, vec<T>& q) {
    vec<T> x = a, y = p;
    a = chosen(where, b, a);
    b = chosen(where, -x, b);
    p = chosen(where, q, p);
    q = chosen(where, -y, q);
}

template <class T> INLINE Principal<T> principal(const mat<T>& F) {
    Principal<T> p;
    const T one = T{} + 1;
    const entry<T> eps = single<T> ? (entry<T>)1e-14 : (entry<T>)1e-32;
    vec<T> b[3] = {{F.m[0], F.m[3], F.m[6]}, {F.m[1], F.m[4], F.m[7]}, {F.m[2], F.m[5], F.m[8]}};
    p.v[0] = {one, T{}, T{}};
    p.v[1] = {T{}, one, T{}};
    p.v[2] = {T{}, T{}, one};
    for (int sweep = 0; sweep < 9; ++sweep) {
        T l[3] = {dot(b[0], b[0]), dot(b[1], b[1]), dot(b[2], b[2])}, all = eps * (l[0] + l[1] + l[2]);
        T x = dot(b[0], b[1]), y = dot(b[0], b[2]), z = dot(b[1], b[2]);  // |u_i . b_j| is to be rounding's of |F|
        auto open = x * x > all * larger(l[0], l[1]) || y * y > all * larger(l[0], l[2]) || z * z > all * larger(l[1], l[2]);
        if (!any(open)) break;
        auto settled = !open;
        part(b[0], b[1], p.v[0], p.v[1], settled);
        part(b[0], b[2], p.v[0], p.v[2], settled);
        part(b[1], b[2], p.v[1], p.v[2], settled);
    }
    swap(dot(b[0], b[0]) < dot(b[1], b[1]), b[0], b[1], p.v[0], p.v[1]);
    swap(dot(b[0], b[0]) < dot(b[2], b[2]), b[0], b[2], p.v[0], p.v[2]);
    swap(dot(b[1], b[1]) < dot(b[2], b[2]), b[1], b[2], p.v[1], p.v[2]);
    T l = dot(b[0], b[0]), inverse = inverse_root(l);
    auto none = !(l > 0);
    p.s[0] = none ? T{} : l * inverse;
    p.u[0] = chosen(none, vec<T>{one, T{}, T{}}, inverse * b[0]);
    vec<T> w = b[1] - dot(p.u[0], b[1]) * p.u[0], x = p.u[0];
    auto flat = !(dot(w, w) > 100 * eps * l);  // only rounding is left: any direction across does
    const vec<T> across[2] = {{one, T{}, T{}}, {T{}, one, T{}}};
    w = chosen(flat, cross(x, chosen(x.x * x.x < (entry<T>)0.5, across[0], across[1])), w);
    p.u[1] = inverse_root(dot(w, w)) * w;
    p.u[2] = cross(p.u[0], p.u[1]);
    p.s[1] = dot(p.u[1], b[1]);
    p.s[2] = dot(p.u[2], b[2]);
    return p;
}
