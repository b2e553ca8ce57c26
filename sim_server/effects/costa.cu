// SPDX-License-Identifier: MIT
// Tetrahedra of Costa's law (formulas: costa.py). All vectors of the rest shape are in the axes of the fibres.
#define WIDE
#include "hyperelastic.cuh"

constexpr int CONSTANTS = 8;  // a [Pa], b of ff, fs, fn, ss, sn, nn [-], bulk [Pa]

struct CostaElements {
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

INLINE constexpr int pair_of(int a, int b) { return a > b ? pair_of(b, a) : a == 0 ? b : a + b + 1; }  // 00, 01, 02, 11, 12, 22

// S = dW/dE of the exponential, and a e^Q.
template <class T> INLINE T exponential(const T (&c)[CONSTANTS], const mat<T>& F, T (&S)[6]) {
    mat<T> C = mul(transposed(F), F);
    const entry<T> half = (entry<T>)0.5;
    T E[6] = {half * (C.m[0] - 1), half * C.m[1], half * C.m[2], half * (C.m[4] - 1), half * C.m[5], half * (C.m[8] - 1)};
    T Q = T{};
    UNROLL for (int k = 0; k < 6; ++k) {
        S[k] = c[1 + k] * E[k];
        Q += (k == 0 || k == 3 || k == 5 ? S[k] : 2 * S[k]) * E[k];
    }
    T stress = c[0] * exp(Q);
    UNROLL for (int k = 0; k < 6; ++k) S[k] = stress * S[k];
    return stress;
}

KERNEL(elements, CostaElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3];
    Tetrahedron<T> t = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    T c[CONSTANTS], volume = at_items(p.volume, i), k = volume * at_items(p.stiffness_coefficient, i), s[6];
    constants_at(p, i, c);
    T stress = exponential(c, t.F, s);
    mat<T> S = symmetric(s[0], s[1], s[2], s[3], s[4], s[5]), Ft = transposed(t.F);
    T dU = c[7] * log(t.J), ddU = c[7] / t.J;

    local_vec3 impulse[4], a[4], u[4];
    UNROLL for (int m = 1; m < 4; ++m) a[m] = mul(t.F, mul(S, t.D[m]));
    set_corner_0(a);
    UNROLL for (int m = 0; m < 4; ++m) {
        impulse[m] = (-p.h * volume) * (a[m] + dU * t.area[m]);
        u[m] = (2 * k / stress) * a[m];
    }
    Blocks6<T> B;
    const entry<T> half = (entry<T>)0.5;
    UNROLL for (int e = 0; e < 6; ++e) {
        const int first = edge_first(e), second = edge_second(e);
        const T I[3] = {t.D[first].x, t.D[first].y, t.D[first].z}, J[3] = {t.D[second].x, t.D[second].y, t.D[second].z};
        mat<T> L;
        UNROLL for (int r = 0; r < 3; ++r) {
            T own = T{};
            UNROLL for (int q = 0; q < 3; ++q) {
                T b = half * stress * c[1 + pair_of(r, q)];
                L.m[3 * r + q] = b * J[r] * I[q];
                own += b * J[q] * I[q];
            }
            L.m[4 * r] += own;
        }
        mat<T> M = mul(t.F, mul(L, Ft));
        UNROLL for (int m = 0; m < 9; ++m) M.m[m] = k * M.m[m];
        add_outer(M, u[first], a[second]);
        add_identity(M, k * dot(t.D[first], mul(S, t.D[second])));
        add_outer(M, (k * ddU) * t.area[first], t.area[second]);
        subtract_cross(M, (k * dU) * opposite(t.q, e));
        B.e[e] = M;
    }
    auto here = t.J <= 0;
    note_refusal(here, p.refused, i, p.clock[0], t.J);
    refuse(here, B, impulse);
    if (p.projection != NONE) {
        auto wrong = indefinite(B);
        if (any(wrong)) project_edges(t.D, p.projection, wrong && !here, B);
    }
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct CostaEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* constants;  // (CONSTANTS, n)
    local* energy;           // (n,) out: V W [J]; NaN where the law is not defined
};

KERNEL(energy, CostaEnergy) {
    typedef exact_number T;  // as that of hyperelastic.cu
    index tet[4];
    Tetrahedron<T> t = element_at<T>(p, i, tet);
    T c[CONSTANTS], s[6];
    constants_at(p, i, c);
    T W = (entry<T>)0.5 * (exponential(c, t.F, s) - c[0]) + c[7] * (t.J * log(t.J) - t.J + 1);
    W = t.J <= 0 ? no_number<T>() : at_items(p.volume, i) * W;
    put(p.energy, i, (local_number)W);
}
