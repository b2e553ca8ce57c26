// SPDX-License-Identifier: MIT
// The blocks of a corotational tetrahedron's usual tangent: with g_a the scaled rotated gradient of corner a,
// h (c + beta) K_ab = (lambda / mu) g_a g_b^T + g_b g_a^T + (g_a . g_b) I. A row is g_a, lambda / mu.
#pragma once
#include "coalesced_io.cuh"

INLINE void add_block(local* s, const local (&a)[4], const local (&b)[4]) {
    local wx = a[3] * a[0], wy = a[3] * a[1], wz = a[3] * a[2], d = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    s[0] += wx * b[0] + b[0] * a[0] + d; s[1] += wx * b[1] + b[0] * a[1];     s[2] += wx * b[2] + b[0] * a[2];
    s[3] += wy * b[0] + b[1] * a[0];     s[4] += wy * b[1] + b[1] * a[1] + d; s[5] += wy * b[2] + b[1] * a[2];
    s[6] += wz * b[0] + b[2] * a[0];     s[7] += wz * b[1] + b[2] * a[1];     s[8] += wz * b[2] + b[2] * a[2] + d;
}

// Upper triangle of (lambda / mu + 1) g g^T + (g . g) I: a corner's own block.
INLINE void add_own(local* s, const local (&g)[4]) {
    local w = g[3] + 1, x = w * g[0], y = w * g[1], d = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
    s[0] += x * g[0] + d; s[1] += x * g[1]; s[2] += x * g[2];
    s[3] += y * g[1] + d; s[4] += y * g[2]; s[5] += w * g[2] * g[2] + d;
}

// Upper triangle of the sum of q q^T: the mean of rotations is linear in the products of their quaternions.
INLINE void add_quaternion_product(local* s, const local (&q)[4]) {
    s[0] += q[0] * q[0]; s[1] += q[0] * q[1]; s[2] += q[0] * q[2]; s[3] += q[0] * q[3];
    s[4] += q[1] * q[1]; s[5] += q[1] * q[2]; s[6] += q[1] * q[3];
    s[7] += q[2] * q[2]; s[8] += q[2] * q[3]; s[9] += q[3] * q[3];
}

// [a]x E [b]x^T, E (6,) the upper triangle of a symmetric matrix: the addition of the exact tangent to the usual one.
INLINE void add_twist(local* s, const local (&a)[4], const local (&b)[4], const local* E) {
    const local xx = E[0], xy = E[1], xz = E[2], yy = E[3], yz = E[4], zz = E[5];
    // E [b]x^T: its rows are b x (row of E)
    local m0 = b[1] * xz - b[2] * xy, m1 = b[2] * xx - b[0] * xz, m2 = b[0] * xy - b[1] * xx;
    local m3 = b[1] * yz - b[2] * yy, m4 = b[2] * xy - b[0] * yz, m5 = b[0] * yy - b[1] * xy;
    local m6 = b[1] * zz - b[2] * yz, m7 = b[2] * xz - b[0] * zz, m8 = b[0] * yz - b[1] * xz;
    s[0] += a[1] * m6 - a[2] * m3; s[1] += a[1] * m7 - a[2] * m4; s[2] += a[1] * m8 - a[2] * m5;
    s[3] += a[2] * m0 - a[0] * m6; s[4] += a[2] * m1 - a[0] * m7; s[5] += a[2] * m2 - a[0] * m8;
    s[6] += a[0] * m3 - a[1] * m0; s[7] += a[0] * m4 - a[1] * m1; s[8] += a[0] * m5 - a[1] * m2;
}

// The same of one corner, a = b = g: the upper triangle (6,) of it.
INLINE void add_own_twist(local* s, const local (&g)[4], const local* E) {
    local t[9] = {};
    add_twist(t, g, g, E);
    s[0] += t[0]; s[1] += t[1]; s[2] += t[2]; s[3] += t[4]; s[4] += t[5]; s[5] += t[8];
}
