// SPDX-License-Identifier: MIT
// Elastic membranes on triangles, as elements of four corners the last of which takes no part (formulas: membrane.py).
#define WIDE
#include "hyperelastic.cuh"

constexpr real MEMBRANE_FLOOR = 0.05;  // J below which ln J goes on as a parabola

template <class T> struct Triangle {
    vec<T> u[3];           // principal directions now, and the normal
    T p[3], q[3], s[2];    // rest gradients of the corners along the principal directions at rest [1/m]; stretches
    T J, I1;
};

// corners (n, 4) nodes, the first of them again as the last; gradients (4, n): at rest, x and y of corners 1 and 2 [1/m].
template <class T, class P> INLINE Triangle<T> triangle_at(const P& p, index i, index (&corner)[4]) {
    get_item_row(p.corner, i, corner);
    vec<T> edges[3];
    field_edges(p.x, corner, edges);
    T D[4];
    UNROLL for (int k = 0; k < 4; ++k) D[k] = at_items(p.gradients + k * p.n, i);
    const entry<T> half = 0.5;
    const T tiny = T{} + (entry<T>)1e-30, one = T{} + 1;
    vec<T> f = D[0] * edges[0] + D[2] * edges[1], g = D[1] * edges[0] + D[3] * edges[1], normal = cross(f, g);
    T a = half * (dot(f, f) - dot(g, g)), b = dot(f, g), r = sqrt(a * a + b * b);
    T c = a < 0 ? b : r + a, s = a < 0 ? r - a : b, size = sqrt(c * c + s * s);
    auto round = !(size > tiny);
    c = round ? one : c / (size + tiny);
    s = round ? T{} : s / (size + tiny);
    Triangle<T> t;
    t.J = sqrt(dot(normal, normal));
    t.I1 = dot(f, f) + dot(g, g);
    vec<T> first = c * f + s * g;
    t.s[0] = sqrt(dot(first, first)) + tiny;
    t.s[1] = t.J / t.s[0];
    t.u[0] = (1 / t.s[0]) * first;
    t.u[2] = (1 / (t.J + tiny)) * normal;
    t.u[1] = cross(t.u[2], t.u[0]);
    UNROLL for (int k = 0; k < 2; ++k) {
        t.p[k + 1] = c * D[2 * k] + s * D[2 * k + 1];
        t.q[k + 1] = c * D[2 * k + 1] - s * D[2 * k];
    }
    t.p[0] = -(t.p[1] + t.p[2]);
    t.q[0] = -(t.q[1] + t.q[2]);
    return t;
}

// ln of the stretch across the membrane, z, at which the stress there is 0: (1 - 2 nu) (e^2z - 1) + 2 nu (ln J + z) = 0.
// Convex in z, and begun at or beyond the root, so that Newton's method comes down to it.
template <class T> INLINE T across(T log_J, T poisson) {
    const T free = 1 - 2 * poisson, tied = 2 * poisson;
    T z = -tied * log_J / (2 * free + tied);
    for (int k = 0; k < 8; ++k) {
        T e = free * exp(2 * z);
        z = z - (e - free + tied * (log_J + z)) / (2 * e + tied);
    }
    return z;
}

struct Membrane {
    int n;                               // elements: triangles
    const int* corner;                   // (n, 4) nodes, the first again as the last
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) world.damping_velocity [m/s]
    const local* gradients;              // (4, n) [1/m]
    const local* volume;                 // (n,) area times thickness without stress [m3]
    const local* constants;              // (2, n) shear modulus [Pa], Poisson's ratio [-]
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    local h;                             // factor of the force [s]
    local* corners;                      // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa [kg]
    local* edges;                        // (6, n, 9) out: factor K_ab, a < b [kg]
};

// The 2x2 matrix 00, 01, 11 without its negative part.
template <class T> INLINE void without_negative(T (&h)[3]) {
    const entry<T> half = 0.5;
    const T tiny = T{} + (entry<T>)1e-30;
    T mean = half * (h[0] + h[2]), d = half * (h[0] - h[2]), r = sqrt(d * d + h[1] * h[1]);
    T high = larger(mean + r, T{}), low = larger(mean - r, T{}), share = half * (high - low) / (r + tiny);
    h[0] = half * (high + low) + share * d;
    h[1] = share * h[1];
    h[2] = half * (high + low) - share * d;
}

KERNEL(elements, Membrane) {
    typedef local_number T;
    index corner[4];
    local_vec3 v[3], impulse[4];
    Triangle<T> t = triangle_at<T>(p, i, corner);
    field_edges(p.v, corner, v);
    T mu = at_items(p.constants, i), nu = at_items(p.constants + p.n, i), volume = at_items(p.volume, i);
    Jet<T> L = logarithm(t.J, T{} + (local)MEMBRANE_FLOOR);
    T e = exp(2 * across(L.f, nu)), by_log = -mu * e;
    T wJ = by_log * L.d, wJJ = by_log * L.dd + 2 * mu * e * nu / ((1 - 2 * nu) * e + nu + (local)1e-30) * L.d * L.d;
    T s = t.s[0], r = t.s[1];
    T stress[2] = {mu * s + wJ * r, mu * r + wJ * s}, h[3] = {mu + wJJ * r * r, wJ + wJJ * s * r, mu + wJJ * s * s};
    without_negative(h);
    const entry<T> half = 0.5;
    T k = volume * at_items(p.stiffness_coefficient, i), twist = larger(mu + wJ, T{}), flip = larger(mu - wJ, T{});
    T plus = half * k * (flip + twist), minus = half * k * (flip - twist);
    T out[2] = {k * larger(stress[0] / s, T{}), k * larger(stress[1] / (r + (local)1e-30), T{})};
    UNROLL for (int m = 0; m < 3; ++m) h[m] = k * h[m];
    UNROLL for (int a = 0; a < 3; ++a)
        impulse[a] = (-p.h * volume) * ((stress[0] * t.p[a]) * t.u[0] + (stress[1] * t.q[a]) * t.u[1]);
    impulse[3] = {T{}, T{}, T{}};
    mat<T> U = {{t.u[0].x, t.u[1].x, t.u[2].x, t.u[0].y, t.u[1].y, t.u[2].y, t.u[0].z, t.u[1].z, t.u[2].z}};
    Blocks6<T> B;
    UNROLL for (int edge = 0; edge < 6; ++edge) {
        const int a = edge_first(edge), b = edge_second(edge);
        B.e[edge] = mat<T>{};
        if (b == 3) continue;
        T pp = t.p[a] * t.p[b], qq = t.q[a] * t.q[b], pq = t.p[a] * t.q[b], qp = t.q[a] * t.p[b], none = T{};
        mat<T> C = {{h[0] * pp + plus * qq, h[1] * pq + minus * qp, none, h[1] * qp + minus * pq, h[2] * qq + plus * pp, none, none,
                     none, out[0] * pp + out[1] * qq}};
        B.e[edge] = mul_transposed(mul(U, C), U);
    }
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct MembraneEnergy {
    int n;                   // elements
    const int* corner;       // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (4, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* constants;  // (2, n)
    local* energy;           // (n,) out [J]
};

KERNEL(energy, MembraneEnergy) {
    typedef exact_number T;  // as that of hyperelastic.cu
    index corner[4];
    Triangle<T> t = triangle_at<T>(p, i, corner);
    T mu = at_items(p.constants, i), nu = at_items(p.constants + p.n, i), L = logarithm(t.J, T{} + (entry<T>)MEMBRANE_FLOOR).f;
    T z = across(L, nu), e = exp(2 * z);
    const entry<T> half = 0.5;
    T W = mu * (half * (t.I1 + e - 3 - (e - 1) * (L + z)) - (L + z));
    put(p.energy, i, (local_number)(at_items(p.volume, i) * W));
}
