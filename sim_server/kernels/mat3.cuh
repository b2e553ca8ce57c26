// SPDX-License-Identifier: MIT
// 3x3 algebra, row major: m[3 * row + column]. load3(a, i) is the i-th triple of an array.
#pragma once
#include "kernel.h"

template <class T> struct mat { T m[9]; };
template <class T> struct vec { T x, y, z; };
typedef mat<number> mat3;
typedef vec<number> vec3;
typedef mat<local_number> local_mat3;
typedef vec<local_number> local_vec3;

template <class A> INLINE auto load3(A a, index i) {
    return vec<decltype(row_at<3>(a, i, 0))>{row_at<3>(a, i, 0), row_at<3>(a, i, 1), row_at<3>(a, i, 2)};
}
template <class A, class T> INLINE void store3(A a, index i, vec<T> v) {
    row_put<3>(a, i, 0, v.x); row_put<3>(a, i, 1, v.y); row_put<3>(a, i, 2, v.z);
}
template <class T> INLINE vec<T> operator+(vec<T> a, vec<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class T> INLINE vec<T> operator-(vec<T> a, vec<T> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class T> INLINE vec<T> operator-(vec<T> a) { return {-a.x, -a.y, -a.z}; }
template <class S, class T> INLINE vec<T> operator*(S s, vec<T> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class M, class T> INLINE vec<T> select(M mask, vec<T> a, vec<T> b) {
    return {mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z};
}
template <class T> INLINE T dot(vec<T> a, vec<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T> INLINE vec<T> cross(vec<T> a, vec<T> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// The same in another precision.
template <class S, class T> INLINE vec<S> as(vec<T> a) { return {(S)a.x, (S)a.y, (S)a.z}; }
template <class S, class T> INLINE mat<S> as(const mat<T>& a) {
    mat<S> s;
    for (int k = 0; k < 9; ++k) s.m[k] = (S)a.m[k];
    return s;
}

template <class A> INLINE auto load9(A a, index i) {
    mat<decltype(row_at<9>(a, i, 0))> s;
    for (int k = 0; k < 9; ++k) s.m[k] = row_at<9>(a, i, k);
    return s;
}

template <class T> INLINE vec<T> row(const mat<T>& a, int r) { return {a.m[3 * r], a.m[3 * r + 1], a.m[3 * r + 2]}; }
template <class T> INLINE T trace(const mat<T>& a) { return a.m[0] + a.m[4] + a.m[8]; }
template <class T> INLINE mat<T> transposed(const mat<T>& a) {
    return {{a.m[0], a.m[3], a.m[6], a.m[1], a.m[4], a.m[7], a.m[2], a.m[5], a.m[8]}};
}
// From the entries 00, 01, 02, 11, 12, 22 of a symmetric one.
template <class T> INLINE mat<T> symmetric(T xx, T xy, T xz, T yy, T yz, T zz) {
    return {{xx, xy, xz, xy, yy, yz, xz, yz, zz}};
}

template <class T> INLINE vec<T> mul(const mat<T>& a, vec<T> v) { return {dot(row(a, 0), v), dot(row(a, 1), v), dot(row(a, 2), v)}; }

template <class T> INLINE mat<T> mul(const mat<T>& a, const mat<T>& b) {
    return {{a.m[0] * b.m[0] + a.m[1] * b.m[3] + a.m[2] * b.m[6],
             a.m[0] * b.m[1] + a.m[1] * b.m[4] + a.m[2] * b.m[7],
             a.m[0] * b.m[2] + a.m[1] * b.m[5] + a.m[2] * b.m[8],
             a.m[3] * b.m[0] + a.m[4] * b.m[3] + a.m[5] * b.m[6],
             a.m[3] * b.m[1] + a.m[4] * b.m[4] + a.m[5] * b.m[7],
             a.m[3] * b.m[2] + a.m[4] * b.m[5] + a.m[5] * b.m[8],
             a.m[6] * b.m[0] + a.m[7] * b.m[3] + a.m[8] * b.m[6],
             a.m[6] * b.m[1] + a.m[7] * b.m[4] + a.m[8] * b.m[7],
             a.m[6] * b.m[2] + a.m[7] * b.m[5] + a.m[8] * b.m[8]}};
}

// sum_a u_a (x) g_a with g_a the rows of g: the gradient of a linear tetrahedron's field from its edge differences
template <class T> INLINE mat<T> outer3(vec<T> u1, vec<T> u2, vec<T> u3, const mat<T>& g) {
    return mul(mat<T>{{u1.x, u2.x, u3.x, u1.y, u2.y, u3.y, u1.z, u2.z, u3.z}}, g);
}
