// SPDX-License-Identifier: MIT
// 3x3 algebra, row major: m[3 * row + column]. load3(a, i) is the i-th triple of an array.
#pragma once
#include "kernel.h"

struct mat3 { number m[9]; };
struct vec3 { number x, y, z; };

INLINE vec3 load3(const real* a, index i) { return {at(a, 3 * i), at(a, 3 * i + 1), at(a, 3 * i + 2)}; }
INLINE void store3(real* a, index i, vec3 v) { put(a, 3 * i, v.x); put(a, 3 * i + 1, v.y); put(a, 3 * i + 2, v.z); }
INLINE vec3 operator+(vec3 a, vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE vec3 operator-(vec3 a, vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
INLINE vec3 operator-(vec3 a) { return {-a.x, -a.y, -a.z}; }
INLINE vec3 operator*(number s, vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
INLINE number dot(vec3 a, vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

INLINE mat3 load9(const real* a, index i) {
    return {{at(a, 9 * i), at(a, 9 * i + 1), at(a, 9 * i + 2), at(a, 9 * i + 3), at(a, 9 * i + 4),
             at(a, 9 * i + 5), at(a, 9 * i + 6), at(a, 9 * i + 7), at(a, 9 * i + 8)}};
}
INLINE void store9(real* a, index i, const mat3& s) {
    put(a, 9 * i, s.m[0]); put(a, 9 * i + 1, s.m[1]); put(a, 9 * i + 2, s.m[2]);
    put(a, 9 * i + 3, s.m[3]); put(a, 9 * i + 4, s.m[4]); put(a, 9 * i + 5, s.m[5]);
    put(a, 9 * i + 6, s.m[6]); put(a, 9 * i + 7, s.m[7]); put(a, 9 * i + 8, s.m[8]);
}

INLINE vec3 row(const mat3& a, int r) { return {a.m[3 * r], a.m[3 * r + 1], a.m[3 * r + 2]}; }
INLINE number trace(const mat3& a) { return a.m[0] + a.m[4] + a.m[8]; }
INLINE mat3 transposed(const mat3& a) {
    return {{a.m[0], a.m[3], a.m[6], a.m[1], a.m[4], a.m[7], a.m[2], a.m[5], a.m[8]}};
}

INLINE vec3 mul(const mat3& a, vec3 v) { return {dot(row(a, 0), v), dot(row(a, 1), v), dot(row(a, 2), v)}; }

INLINE mat3 mul(const mat3& a, const mat3& b) {
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
INLINE mat3 outer3(vec3 u1, vec3 u2, vec3 u3, const mat3& g) {
    return mul(mat3{{u1.x, u2.x, u3.x, u1.y, u2.y, u3.y, u1.z, u2.z, u3.z}}, g);
}
