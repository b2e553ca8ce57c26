// SPDX-License-Identifier: MIT
// Rotation of an element from an edge and a face by Gram-Schmidt orthogonalization, in place of the nearest rotation.
#pragma once
#include "polar.cuh"

template <class T> INLINE vec<T> unit(vec<T> a) { return (1 / sqrt(dot(a, a))) * a; }
template <class M, class T> INLINE vec<T> pick(M first, vec<T> a, vec<T> b) {
    return {first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
}

// Unit vector orthogonal to the unit vector a, from the axis with the smallest component of a.
template <class T> INLINE vec<T> across(vec<T> a) {
    T x = a.x * a.x, y = a.y * a.y, z = a.z * a.z, one = T{} + 1;
    vec<T> axis = pick(x < y, pick(x < z, vec<T>{one, T{}, T{}}, vec<T>{T{}, T{}, one}),
                       pick(y < z, vec<T>{T{}, one, T{}}, vec<T>{T{}, T{}, one}));
    return unit(cross(a, axis));
}

// Rotation that takes the unit vector `edge` to the direction of `first`, and the unit vector `normal` across it to the direction of
// first x second; lengths are near 1. Where they give no direction, any direction is taken.
template <class T> INLINE mat<T> rotation_between(vec<T> edge, vec<T> normal, vec<T> first, vec<T> second) {
    const T none = T{} + (single<T> ? (entry<T>)1e-12 : (entry<T>)1e-24);  // of a square
    T length2 = dot(first, first);
    vec<T> b1 = pick(length2 > none, (1 / sqrt(larger(length2, none))) * first, edge);
    vec<T> area = cross(b1, second);
    T area2 = dot(area, area);
    vec<T> b3 = pick(area2 > none, (1 / sqrt(larger(area2, none))) * area, across(b1));
    vec<T> b2 = cross(b3, b1), a2 = cross(normal, edge);
    return {{b1.x * edge.x + b2.x * a2.x + b3.x * normal.x, b1.x * edge.y + b2.x * a2.y + b3.x * normal.y,
             b1.x * edge.z + b2.x * a2.z + b3.x * normal.z, b1.y * edge.x + b2.y * a2.x + b3.y * normal.x,
             b1.y * edge.y + b2.y * a2.y + b3.y * normal.y, b1.y * edge.z + b2.y * a2.z + b3.y * normal.z,
             b1.z * edge.x + b2.z * a2.x + b3.z * normal.x, b1.z * edge.y + b2.z * a2.y + b3.z * normal.y,
             b1.z * edge.z + b2.z * a2.z + b3.z * normal.z}};
}

// Unit quaternion of a rotation: the column of 4 q q^T with the largest diagonal entry.
template <class T> INLINE quaternion<T> quaternion_of(const mat<T>& R) {
    const T* r = R.m;
    T wx = r[7] - r[5], wy = r[2] - r[6], wz = r[3] - r[1], xy = r[1] + r[3], xz = r[2] + r[6], yz = r[5] + r[7];
    T ww = 1 + r[0] + r[4] + r[8], xx = 1 + r[0] - r[4] - r[8], yy = 1 - r[0] + r[4] - r[8], zz = 1 - r[0] - r[4] + r[8];
    T best = T{};
    quaternion<T> q = better({ww, wx, wy, wz}, ww, {T{} + 1, T{}, T{}, T{}}, best);
    q = better({wx, xx, xy, xz}, xx, q, best);
    q = better({wy, xy, yy, yz}, yy, q, best);
    q = better({wz, xz, yz, zz}, zz, q, best);
    T norm = 1 / sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    return {norm * q.w, norm * q.x, norm * q.y, norm * q.z};
}
