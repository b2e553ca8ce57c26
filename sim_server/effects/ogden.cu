// SPDX-License-Identifier: MIT
// Tetrahedra of Ogden's law, by principal stretches (formulas: ogden.py).
#define WIDE
#include "hyperelastic.cuh"

constexpr int TERMS = 3, CONSTANTS = 2 * TERMS + 1;  // mu_p [Pa], alpha_p [-], bulk [Pa]

struct OgdenElements {
    int n;                               // elements
    int projection;                      // of the tangent
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) what the tangent is applied to [m/s]
    const local* gradients;              // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* volume;                 // (n,) [m3]
    const local* constants;              // (CONSTANTS, n)
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    local h;                             // factor of the force [s]
    const double* clock;                 // (1,) [s]
    double* refused;                     // (n, 2) in, out: when the element was first refused [s], -1: never; its J then
    local* corners;                      // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa [kg]
    local* edges;                        // (6, n, 9) out: factor K_ab, a < b [kg]
};

// t_i = s_i dW/ds_i and m_ij = s_j dt_i/ds_j (00, 01, 02, 11, 12, 22); returns W.
template <class T> INLINE T logarithmic(const T (&c)[CONSTANTS], const T (&s)[3], T J, T (&t)[3], T (&m)[6]) {
    const entry<T> third = (entry<T>)(1. / 3);
    T L = log(J), W = (entry<T>)0.5 * c[2 * TERMS] * L * L, l[3];
    UNROLL for (int i = 0; i < 3; ++i) {
        l[i] = log(s[i]);
        t[i] = c[2 * TERMS] * L;
    }
    UNROLL for (int k = 0; k < 6; ++k) m[k] = c[2 * TERMS];
    UNROLL for (int p = 0; p < TERMS; ++p) {
        T a = c[TERMS + p], u[3];
        UNROLL for (int i = 0; i < 3; ++i) u[i] = c[p] * exp(a * (l[i] - third * L));  // mu J^(-alpha/3) s_i^alpha
        T sum = u[0] + u[1] + u[2];
        W += (sum - 3 * c[p]) / a;
        UNROLL for (int i = 0; i < 3; ++i) {
            t[i] += u[i] - third * sum;
            UNROLL for (int j = i; j < 3; ++j)
                m[i == 0 ? j : i + j + 1] += third * a * (third * sum - u[i] - u[j]) + (i == j ? a * u[i] : T{});
        }
    }
    return W;
}

KERNEL(elements, OgdenElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3];
    Tetrahedron<T> e = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    T c[CONSTANTS], volume = at_items(p.volume, i), t[3], m[6], slope[3], inverse[3];
    constants_at(p, i, c);
    Principal<T> frame = principal(e.F);
    const T (&s)[3] = frame.s;
    logarithmic(c, s, s[0] * s[1] * s[2], t, m);
    Modes<T> modes;
    UNROLL for (int k = 0; k < 3; ++k) {
        inverse[k] = 1 / s[k];
        slope[k] = t[k] * inverse[k];
    }
    UNROLL for (int a = 0; a < 3; ++a) {
        UNROLL for (int b = a; b < 3; ++b) {
            T h = (a == b ? m[a == 0 ? b : a + b + 1] - t[a] : m[a == 0 ? b : a + b + 1]) * inverse[a] * inverse[b];
            modes.stretch[a == 0 ? b : a + b + 1] = h;
        }
    }
    const entry<T> near = single<T> ? (entry<T>)3e-3 : (entry<T>)1e-5;  // rounding of the quotient meets the limit's error
    UNROLL for (int k = 0; k < 3; ++k) {
        constexpr int first[3] = {1, 0, 0}, second[3] = {2, 2, 1};
        const int a = first[k], b = second[k];
        T sum = s[a] + s[b], difference = s[a] - s[b];
        T limit = (entry<T>)0.5 * (modes.stretch[a == 0 ? 0 : 3] + modes.stretch[b == 1 ? 3 : 5]) - modes.stretch[a == 0 ? b : 4];
        modes.twist[k] = (slope[a] + slope[b]) / sum;
        modes.flip[k] = magnitude(difference) > near * sum ? (slope[a] - slope[b]) / difference : limit;
    }
    project(modes, p.projection);

    local_vec3 impulse[4];
    UNROLL for (int k = 1; k < 4; ++k) {  // -h V U diag(dW/ds) V^T D
        impulse[k] = (slope[0] * dot(frame.v[0], e.D[k])) * frame.u[0];
        impulse[k] = impulse[k] + (slope[1] * dot(frame.v[1], e.D[k])) * frame.u[1];
        impulse[k] = (-p.h * volume) * (impulse[k] + (slope[2] * dot(frame.v[2], e.D[k])) * frame.u[2]);
    }
    set_corner_0(impulse);
    Blocks6<T> B;
    principal_edges(frame, modes, volume * at_items(p.stiffness_coefficient, i), e.D, B);
    auto here = e.J <= 0;
    note_refusal(here, p.refused, i, p.clock[0], e.J);
    refuse(here, B, impulse);
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct OgdenEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* constants;  // (CONSTANTS, n)
    local* energy;           // (n,) out: V W [J]; NaN where the law is not defined
};

KERNEL(energy, OgdenEnergy) {
    typedef exact_number T;  // as that of hyperelastic.cu
    index tet[4];
    Tetrahedron<T> e = element_at<T>(p, i, tet);
    T c[CONSTANTS], t[3], m[6];
    constants_at(p, i, c);
    Principal<T> frame = principal(e.F);
    T W = logarithmic(c, frame.s, e.J, t, m);
    W = e.J <= 0 ? no_number<T>() : at_items(p.volume, i) * W;
    put(p.energy, i, (local_number)W);
}
