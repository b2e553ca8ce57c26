// SPDX-License-Identifier: MIT
// The rotation nearest to F: argmax over proper rotations R of tr(R^T F), i.e. the polar factor where det F > 0 and its
// continuation through flat and inverted F (smallest singular value negative: Irving, Teran, Fedkiw 2004). A pure function of
// F, on a CPU without branches, so that it vectorizes and replays.
//
// tr(R(q)^T F) = q^T N q for a unit quaternion q (Horn 1987), so q is the eigenvector of the symmetric traceless 4x4 N of its
// largest eigenvalue: Laguerre's iteration on the quartic from above, q from the adjugate of (lambda I - N), then steps on
// SO(3) to rounding. With singular values s1 >= s2 >= |s3| it is exact to rounding while s2 + s3 > 1e-5 s1; below that, on the
// way to where the nearest rotation is not unique (s2 + s3 = 0: needles, reflections), tr(R^T F) is within 1e-5 s1 of its
// maximum. F = 0 gives the identity.
#pragma once
#include "mat3.cuh"

template <class T> constexpr bool single = sizeof(entry<T>) == 4;

template <class T> struct quaternion { T w, x, y, z; };

template <class T> INLINE mat<T> rotation_matrix(quaternion<T> q) {
    T s = 2 / (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    T wx = s * q.w * q.x, wy = s * q.w * q.y, wz = s * q.w * q.z;
    T xx = s * q.x * q.x, xy = s * q.x * q.y, xz = s * q.x * q.z;
    T yy = s * q.y * q.y, yz = s * q.y * q.z, zz = s * q.z * q.z;
    return {{1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy}};
}

// On a GPU an iteration may end early; on a CPU its neighbours in the vector go on. What follows makes up for the rounding of
// root and ratio.
#ifdef __CUDACC_RTC__
INLINE float root(float a) {
    float r;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(r) : "f"(a));
    return r;
}
INLINE double root(double a) { return sqrt(a); }
INLINE float ratio(float a, float b) { return __fdividef(a, b); }
INLINE double ratio(double a, double b) { return a / b; }
// u and s to their ratio, where float32 has no subnormal numbers for their squares (CuPy turns them off).
template <class T> INLINE void lift(T& u, T& s) { s = ratio(s, u); u = 1; }
template <class T> INLINE bool settled(T step, T value) { return !(step > (single<T> ? (T)1e-4 : (T)1e-14) * value); }
#else
template <class T> INLINE T root(T a) { return sqrt(a); }
template <class T> INLINE T ratio(T a, T b) { return a / b; }
template <class T> INLINE void lift(T&, T&) {}
template <class T> INLINE constexpr bool settled(T, T) { return false; }
#endif

// Largest root of det(lambda I - N) = l^4 - 2 |F|^2 l^2 - 8 det F l + |F|^4 - 4 |cof F|^2, |F| = 1. All roots are real, below
// sqrt(3) |F| >= s1 + s2 + s3, so that Laguerre's iteration falls from there monotonically; it is cubic at a simple root, and
// where two or three meet an iteration still takes away 3/4 or 2/3 of the distance (Newton's 1/2 or 1/3).
template <class T> INLINE T largest_root(T norm2, T det, T cofactor2) {
    T c0 = norm2 * norm2 - 4 * cofactor2;
    T l = sqrt(3 * norm2);
    const T flat = T{} + (single<T> ? (entry<T>)1e-3 : (entry<T>)1e-8);  // where roots meet only rounding is left
    for (int k = 0; k < 8; ++k) {
        T f = larger(((l * l - 2 * norm2) * l - 8 * det) * l + c0, T{});
        T slope = (4 * l * l - 4 * norm2) * l - 8 * det, bend = 12 * l * l - 4 * norm2;
        T step = ratio(4 * f, larger(slope + root(larger(9 * slope * slope - 12 * f * bend, T{})), flat));
        l -= step;
        if (settled(step, l)) break;
    }
    return l;
}

// u where u_k (its own diagonal entry of the adjugate) is larger than the best so far, else q.
template <class T> INLINE quaternion<T> better(quaternion<T> u, T u_k, quaternion<T> q, T& best) {
    auto take = u_k > best;
    best = take ? u_k : best;
    return {take ? u.w : q.w, take ? u.x : q.x, take ? u.y : q.y, take ? u.z : q.z};
}

// Column of the adjugate of the symmetric positive semi-definite (lambda I - N) with the largest diagonal entry.
template <class T> INLINE quaternion<T> null_vector(T l, const mat<T>& F) {
    const T* f = F.m;
    T a = l - (f[0] + f[4] + f[8]), b = f[5] - f[7], c = f[6] - f[2], d = f[1] - f[3];
    T e = l - (f[0] - f[4] - f[8]), g = -(f[1] + f[3]), h = -(f[2] + f[6]);
    T k = l - (f[4] - f[0] - f[8]), m = -(f[5] + f[7]), n = l - (f[8] - f[0] - f[4]);
    // 2x2 minors of rows 2,3 and of rows 0,1
    T s23 = k * n - m * m, s13 = g * n - m * h, s12 = g * m - k * h;
    T s03 = c * n - m * d, s02 = c * m - k * d, s01 = c * h - g * d;
    T t01 = a * e - b * b, t02 = a * g - c * b, t03 = a * h - d * b;
    T t12 = b * g - c * e, t13 = b * h - d * e;
    quaternion<T> q0 = {e * s23 - g * s13 + h * s12, -(b * s23 - g * s03 + h * s02), b * s13 - e * s03 + h * s01,
                     -(b * s12 - e * s02 + g * s01)};
    quaternion<T> q1 = {q0.x, a * s23 - c * s03 + d * s02, -(a * s13 - b * s03 + d * s01), a * s12 - b * s02 + c * s01};
    quaternion<T> q2 = {q0.y, q1.y, h * t03 * -1 + n * t01 + d * t13, -(m * t01 - g * t03 + c * t13)};
    quaternion<T> q3 = {q0.z, q1.z, q2.z, k * t01 - g * t02 + c * t12};
    T best = T{};
    quaternion<T> q = better(q0, q0.w, {T{} + 1, T{}, T{}, T{}}, best);
    q = better(q1, q1.x, q, best);
    q = better(q2, q2.y, q, best);
    return better(q3, q3.z, q, best);
}

// A unit quaternion, by how much it was turned last, and whether the maximum is beside it.
template <class T> struct turned { quaternion<T> q; T tangent2, definite; };

// The best turn about Newton's axis: with S = R^T F and H = tr S I - sym S, the axis is w = adj(H) axial S (it needs no
// division, and H may be singular or indefinite), and tr(Rot(w, t)^T S) = const + c cos t + s sin t is largest at
// tan t = s / c. So a step never loses, from wherever it starts, and near the optimum it is Newton's.
template <class T> INLINE turned<T> turn(quaternion<T> q, const mat<T>& F) {
    mat<T> S = mul(transposed(rotation_matrix(q)), F);
    const T* s = S.m;
    vec<T> g = {s[7] - s[5], s[2] - s[6], s[3] - s[1]};
    T a = s[4] + s[8], b = s[0] + s[8], c = s[0] + s[4];
    T d = (entry<T>)-0.5 * (s[1] + s[3]), e = (entry<T>)-0.5 * (s[2] + s[6]), f = (entry<T>)-0.5 * (s[5] + s[7]);
    T A = b * c - f * f, B = e * f - d * c, C = d * f - b * e, D = d * e - a * f;
    vec<T> w = {A * g.x + B * g.y + C * g.z, B * g.x + (a * c - e * e) * g.y + D * g.z,
              C * g.x + D * g.y + (a * b - d * d) * g.z};
    T cosine = dot(w, vec<T>{a * w.x + d * w.y + e * w.z, d * w.x + b * w.y + f * w.z, e * w.x + f * w.y + c * w.z});
    T sine = dot(w, g);  // over |w|
    const entry<T> none = single<T> ? (entry<T>)1e-18 : (entry<T>)1e-37;  // w = 0: no turn; its square must not be 0
    T u = cosine + root(cosine * cosine + sine * sine * dot(w, w)) + none;
    lift(u, sine);
    const T tangent2 = sine * sine * dot(w, w), definite = smaller(smaller(a, a * b - d * d), a * A + d * B + e * C);
    T wx = sine * w.x, wy = sine * w.y, wz = sine * w.z;
    quaternion<T> p = {u * q.w - q.x * wx - q.y * wy - q.z * wz, u * q.x + q.w * wx + q.y * wz - q.z * wy,
                    u * q.y + q.w * wy + q.z * wx - q.x * wz, u * q.z + q.w * wz + q.x * wy - q.y * wx};
    T norm = 1 / sqrt(p.w * p.w + p.x * p.x + p.y * p.y + p.z * p.z);
    return {{norm * p.w, norm * p.x, norm * p.y, norm * p.z}, tangent2 / (u * u), definite};
}

template <class T> INLINE quaternion<T> polish(quaternion<T> q, const mat<T>& F) { return turn(q, F).q; }

template <class T> INLINE T square(const mat<T>& a) {
    return dot(row(a, 0), row(a, 0)) + dot(row(a, 1), row(a, 1)) + dot(row(a, 2), row(a, 2));
}

// |F| = 1 and what the quartic needs of it.
template <class T> struct scaled {
    mat<T> F;
    T det, cofactor2;
};

template <class T> INLINE scaled<T> to_scale(mat<T> F) {
    T scale = 1 / (sqrt(square(F)) + (entry<T>)1e-37);  // what follows has powers of |F| up to the twelfth
    for (int k = 0; k < 9; ++k) F.m[k] *= scale;
    const T* f = F.m;
    T c00 = f[4] * f[8] - f[5] * f[7], c01 = f[5] * f[6] - f[3] * f[8], c02 = f[3] * f[7] - f[4] * f[6];
    T c10 = f[2] * f[7] - f[1] * f[8], c11 = f[0] * f[8] - f[2] * f[6], c12 = f[1] * f[6] - f[0] * f[7];
    T c20 = f[1] * f[5] - f[2] * f[4], c21 = f[2] * f[3] - f[0] * f[5], c22 = f[0] * f[4] - f[1] * f[3];
    T det = f[0] * c00 + f[1] * c01 + f[2] * c02;
    return {F, det, square(mat<T>{{c00, c01, c02, c10, c11, c12, c20, c21, c22}})};
}

// A shift off the root keeps the adjugate from vanishing where roots meet; the steps on SO(3) take its error out.
template <class T> INLINE quaternion<T> beside_root(T l, const mat<T>& F) {
    return null_vector(l + (single<T> ? (entry<T>)1e-3 : (entry<T>)1e-6), F);
}

template <class T> INLINE quaternion<T> nearest_by_root(const mat<T>& F) {
    scaled<T> a = to_scale(F);
    quaternion<T> q = beside_root(largest_root(square(a.F), a.det, a.cofactor2), a.F);
    q = polish(q, a.F);
    q = polish(q, a.F);
    return polish(q, a.F);
}

#ifdef __CUDACC_RTC__

__device__ __noinline__ void by_root(const double* f, double* q) {
    mat<double> F;
    for (int k = 0; k < 9; ++k) F.m[k] = f[k];
    quaternion<double> found = nearest_by_root(F);
    q[0] = found.w; q[1] = found.x; q[2] = found.y; q[3] = found.z;
}

// By a call: it is rare, and its registers would be everybody's.
INLINE quaternion<double> nearest_the_long_way(const mat<double>& F) {
    double f[9], q[4];
    for (int k = 0; k < 9; ++k) f[k] = F.m[k];
    by_root(f, q);
    return {q[0], q[1], q[2], q[3]};
}

// Newton's step on SO(3) from nearby, where its turn is so small that the half of it is all. turn2: square of the angle.
INLINE quaternion<double> newton(quaternion<double> q, const mat<double>& F, double& turn2) {
    double more = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z - 1, t = 2 - 2 * more * (1 - more);  // 2 / |q|^2
    double tx = t * q.x, ty = t * q.y, tz = t * q.z, wx = q.w * tx, wy = q.w * ty, wz = q.w * tz;
    double xx = q.x * tx, yy = q.y * ty, zz = q.z * tz, xy = q.x * ty, xz = q.x * tz, yz = q.y * tz;
    mat<double> R = {{1 - yy - zz, xy + wz, xz - wy, xy - wz, 1 - xx - zz, yz + wx, xz + wy, yz - wx, 1 - xx - yy}};  // transposed
    mat<double> S = mul(R, F);
    const double* s = S.m;
    vec<double> g = {s[7] - s[5], s[2] - s[6], s[3] - s[1]};
    double a = s[4] + s[8], b = s[0] + s[8], c = s[0] + s[4];
    double d = -0.5 * (s[1] + s[3]), e = -0.5 * (s[2] + s[6]), f = -0.5 * (s[5] + s[7]);
    double A = b * c - f * f, B = e * f - d * c, C = d * f - b * e, D = d * e - a * f;
    double half = 0.5 / (a * A + d * B + e * C);  // 1 / (2 det H)
    vec<double> w = half * vec<double>{A * g.x + B * g.y + C * g.z, B * g.x + (a * c - e * e) * g.y + D * g.z,
                                       C * g.x + D * g.y + (a * b - d * d) * g.z};
    turn2 = 4 * dot(w, w);
    double norm = rsqrt((1 + dot(w, w)) * (1 + more));
    return {norm * (q.w - q.x * w.x - q.y * w.y - q.z * w.z), norm * (q.x + q.w * w.x + q.y * w.z - q.z * w.y),
            norm * (q.y + q.w * w.y + q.z * w.x - q.x * w.z), norm * (q.z + q.w * w.z + q.x * w.y - q.y * w.x)};
}

INLINE quaternion<float> nearest_quaternion(const mat<float>& F) { return nearest_by_root(F); }

// As above, begun in float32. Where that does not suffice, beside roots that meet, the long way.
INLINE quaternion<double> nearest_quaternion(const mat<double>& F) {
    double largest = 0;
    for (int k = 0; k < 9; ++k) largest = fmax(largest, fabs(F.m[k]));
    const double scale = 1 / (largest + 1e-37);
    mat<double> G;
    for (int k = 0; k < 9; ++k) G.m[k] = scale * F.m[k];
    scaled<float> a = to_scale(as<float>(G));
    float norm2 = square(a.F), l = largest_root(norm2, a.det, a.cofactor2);
    float slope = (4 * l * l - 4 * norm2) * l - 8 * a.det;
    quaternion<float> start = polish(beside_root(l, a.F), a.F);
    double turn2;
    quaternion<double> q = {start.w, start.x, start.y, start.z};
    q = newton(q, G, turn2);
    q = newton(q, G, turn2);
    return slope > 0.05f && turn2 < 1e-17 ? q : nearest_the_long_way(F);
}

#else

template <class T> INLINE quaternion<T> nearest_quaternion(const mat<T>& F) { return nearest_by_root(F); }

#endif

// The same, begun at a quaternion that is near it, as that of a state shortly before. Where the last turn is so large that another
// would matter, or it is no maximum (H, above, is not definite), from the root.
template <class T> INLINE quaternion<T> nearest_quaternion(const mat<T>& F, quaternion<T> near) {
#ifdef __CUDACC_RTC__
    return nearest_quaternion(F);
#else
    const T scale = 1 / (sqrt(square(F)) + (entry<T>)1e-37);
    mat<T> G;
    for (int k = 0; k < 9; ++k) G.m[k] = scale * F.m[k];
    const turned<T> last = turn(polish(near, G), G);
    const entry<T> small = (entry<T>)1e-12, least = (entry<T>)1e-3;
    auto off = !(small > last.tangent2 && last.definite > least);
    if (!any(off)) return last.q;
    const quaternion<T> q = nearest_by_root(F);
    return {off ? q.w : last.q.w, off ? q.x : last.q.x, off ? q.y : last.q.y, off ? q.z : last.q.z};
#endif
}

template <class T> INLINE mat<T> nearest_rotation(const mat<T>& F) { return rotation_matrix(nearest_quaternion(F)); }
