// SPDX-License-Identifier: MIT
// The rotation nearest to F: argmax over proper rotations R of tr(R^T F), i.e. the polar factor where det F > 0 and its
// continuation through flat and inverted F (smallest singular value negative: Irving, Teran, Fedkiw 2004). A pure function of
// F, without branches, so that it vectorizes and replays.
//
// tr(R(q)^T F) = q^T N q for a unit quaternion q (Horn 1987), so q is the eigenvector of the symmetric traceless 4x4 N of its
// largest eigenvalue: Laguerre's iteration on the quartic from above, q from the adjugate of (lambda I - N), then steps on
// SO(3) to rounding. With singular values s1 >= s2 >= |s3| it is exact to rounding while s2 + s3 > 1e-5 s1; below that, on the
// way to where the nearest rotation is not unique (s2 + s3 = 0: needles, reflections), tr(R^T F) is within 1e-5 s1 of its
// maximum. F = 0 gives the identity.
#pragma once
#include "mat3.cuh"

struct quaternion { number w, x, y, z; };

INLINE mat3 rotation_matrix(quaternion q) {
    number s = 2 / (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    number wx = s * q.w * q.x, wy = s * q.w * q.y, wz = s * q.w * q.z;
    number xx = s * q.x * q.x, xy = s * q.x * q.y, xz = s * q.x * q.z;
    number yy = s * q.y * q.y, yz = s * q.y * q.z, zz = s * q.z * q.z;
    return {{1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy}};
}

// Largest root of det(lambda I - N) = l^4 - 2 |F|^2 l^2 - 8 det F l + |F|^4 - 4 |cof F|^2, |F| = 1. All roots are real, below
// sqrt(3) |F| >= s1 + s2 + s3, so that Laguerre's iteration falls from there monotonically; it is cubic at a simple root, and
// where two or three meet an iteration still takes away 3/4 or 2/3 of the distance (Newton's 1/2 or 1/3).
INLINE number largest_root(number norm2, number det, number cofactor2) {
    number c0 = norm2 * norm2 - 4 * cofactor2;
    number l = sqrt(3 * norm2);
    const number flat = constant(sizeof(real) == 4 ? (real)1e-3 : (real)1e-8);  // where roots meet only rounding is left
    for (int k = 0; k < 8; ++k) {
        number f = larger(((l * l - 2 * norm2) * l - 8 * det) * l + c0, number{});
        number slope = (4 * l * l - 4 * norm2) * l - 8 * det, bend = 12 * l * l - 4 * norm2;
        l -= 4 * f / larger(slope + sqrt(larger(9 * slope * slope - 12 * f * bend, number{})), flat);
    }
    return l;
}

// u where u_k (its own diagonal entry of the adjugate) is larger than the best so far, else q.
INLINE quaternion better(quaternion u, number u_k, quaternion q, number& best) {
    auto take = u_k > best;
    best = take ? u_k : best;
    return {take ? u.w : q.w, take ? u.x : q.x, take ? u.y : q.y, take ? u.z : q.z};
}

// Column of the adjugate of the symmetric positive semi-definite (lambda I - N) with the largest diagonal entry.
INLINE quaternion null_vector(number l, const mat3& F) {
    const number* f = F.m;
    number a = l - (f[0] + f[4] + f[8]), b = f[5] - f[7], c = f[6] - f[2], d = f[1] - f[3];
    number e = l - (f[0] - f[4] - f[8]), g = -(f[1] + f[3]), h = -(f[2] + f[6]);
    number k = l - (f[4] - f[0] - f[8]), m = -(f[5] + f[7]), n = l - (f[8] - f[0] - f[4]);
    // 2x2 minors of rows 2,3 and of rows 0,1
    number s23 = k * n - m * m, s13 = g * n - m * h, s12 = g * m - k * h;
    number s03 = c * n - m * d, s02 = c * m - k * d, s01 = c * h - g * d;
    number t01 = a * e - b * b, t02 = a * g - c * b, t03 = a * h - d * b;
    number t12 = b * g - c * e, t13 = b * h - d * e;
    quaternion q0 = {e * s23 - g * s13 + h * s12, -(b * s23 - g * s03 + h * s02), b * s13 - e * s03 + h * s01,
                     -(b * s12 - e * s02 + g * s01)};
    quaternion q1 = {q0.x, a * s23 - c * s03 + d * s02, -(a * s13 - b * s03 + d * s01), a * s12 - b * s02 + c * s01};
    quaternion q2 = {q0.y, q1.y, h * t03 * -1 + n * t01 + d * t13, -(m * t01 - g * t03 + c * t13)};
    quaternion q3 = {q0.z, q1.z, q2.z, k * t01 - g * t02 + c * t12};
    number best = number{};
    quaternion q = better(q0, q0.w, {constant(1), number{}, number{}, number{}}, best);
    q = better(q1, q1.x, q, best);
    q = better(q2, q2.y, q, best);
    return better(q3, q3.z, q, best);
}

// The best turn about Newton's axis: with S = R^T F and H = tr S I - sym S, the axis is w = adj(H) axial S (it needs no
// division, and H may be singular or indefinite), and tr(Rot(w, t)^T S) = const + c cos t + s sin t is largest at
// tan t = s / c. So a step never loses, from wherever it starts, and near the optimum it is Newton's.
INLINE quaternion polish(quaternion q, const mat3& F) {
    mat3 S = mul(transposed(rotation_matrix(q)), F);
    const number* s = S.m;
    vec3 g = {s[7] - s[5], s[2] - s[6], s[3] - s[1]};
    number a = s[4] + s[8], b = s[0] + s[8], c = s[0] + s[4];
    number d = (real)-0.5 * (s[1] + s[3]), e = (real)-0.5 * (s[2] + s[6]), f = (real)-0.5 * (s[5] + s[7]);
    number A = b * c - f * f, B = e * f - d * c, C = d * f - b * e, D = d * e - a * f;
    vec3 w = {A * g.x + B * g.y + C * g.z, B * g.x + (a * c - e * e) * g.y + D * g.z,
              C * g.x + D * g.y + (a * b - d * d) * g.z};
    number cosine = dot(w, vec3{a * w.x + d * w.y + e * w.z, d * w.x + b * w.y + f * w.z, e * w.x + f * w.y + c * w.z});
    number sine = dot(w, g);  // over |w|
    const real none = sizeof(real) == 4 ? (real)1e-18 : (real)1e-37;  // w = 0: no turn; its square must not be 0
    number u = cosine + sqrt(cosine * cosine + sine * sine * dot(w, w)) + none;
    number wx = sine * w.x, wy = sine * w.y, wz = sine * w.z;
    quaternion p = {u * q.w - q.x * wx - q.y * wy - q.z * wz, u * q.x + q.w * wx + q.y * wz - q.z * wy,
                    u * q.y + q.w * wy + q.z * wx - q.x * wz, u * q.z + q.w * wz + q.x * wy - q.y * wx};
    number norm = 1 / sqrt(p.w * p.w + p.x * p.x + p.y * p.y + p.z * p.z);
    return {norm * p.w, norm * p.x, norm * p.y, norm * p.z};
}

INLINE number square(const mat3& a) {
    return dot(row(a, 0), row(a, 0)) + dot(row(a, 1), row(a, 1)) + dot(row(a, 2), row(a, 2));
}

INLINE quaternion nearest_quaternion(mat3 F) {
    number scale = 1 / (sqrt(square(F)) + (real)1e-37);  // what follows has powers of |F| up to the twelfth
    for (int k = 0; k < 9; ++k) F.m[k] *= scale;
    const number* f = F.m;
    number c00 = f[4] * f[8] - f[5] * f[7], c01 = f[5] * f[6] - f[3] * f[8], c02 = f[3] * f[7] - f[4] * f[6];
    number c10 = f[2] * f[7] - f[1] * f[8], c11 = f[0] * f[8] - f[2] * f[6], c12 = f[1] * f[6] - f[0] * f[7];
    number c20 = f[1] * f[5] - f[2] * f[4], c21 = f[2] * f[3] - f[0] * f[5], c22 = f[0] * f[4] - f[1] * f[3];
    number det = f[0] * c00 + f[1] * c01 + f[2] * c02;
    number cofactor2 = square(mat3{{c00, c01, c02, c10, c11, c12, c20, c21, c22}});
    // A shift off the root keeps the adjugate from vanishing where roots meet; the steps on SO(3) take its error out.
    number l = largest_root(square(F), det, cofactor2);
    quaternion q = null_vector(l + (sizeof(real) == 4 ? (real)1e-3 : (real)1e-6), F);
    q = polish(q, F);
    q = polish(q, F);
    return polish(q, F);
}

INLINE mat3 nearest_rotation(const mat3& F) { return rotation_matrix(nearest_quaternion(F)); }
