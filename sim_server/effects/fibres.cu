// SPDX-License-Identifier: MIT
// One or two families of fibres in tetrahedra (formulas: fibres.py). Semi-definite by itself: nothing is projected.
#define WIDE
#include "hyperelastic.cuh"

struct FibresElements {
    int n;                               // elements
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) what the tangent is applied to [m/s]
    const local* gradients;              // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* volume;                 // (n,) [m3]
    const local* constants;              // (2, n) stiffness [Pa], exponent [-]
    const local* directions;             // (6, n) of two families at rest; 0: no such family
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    local h;                             // factor of the force [s]
    local* corners;                      // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa [kg]
    local* edges;                        // (6, n, 9) out: factor K_ab, a < b [kg]
};

template <class T> struct Family {
    vec<T> rest, now;  // direction, F times it
    T stretch;         // I4 - 1, 0 where the fibre is slack or there is none
};

template <class T> INLINE Family<T> family(const local* directions, int n, index i, int which, const mat<T>& F) {
    Family<T> f;
    f.rest = {at(directions, 3 * which * n + i), at(directions, (3 * which + 1) * n + i), at(directions, (3 * which + 2) * n + i)};
    f.now = mul(F, f.rest);
    f.stretch = larger(dot(f.now, f.now) - 1, T{});
    return f;
}

KERNEL(elements, FibresElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3], impulse[4];
    Tetrahedron<T> t = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    T volume = at_items(p.volume, i), k = volume * at_items(p.stiffness_coefficient, i), k1 = at_items(p.constants, i), k2 = at_items(p.constants + p.n, i);
    Blocks6<T> B;
    UNROLL for (int a = 0; a < 4; ++a) impulse[a] = {T{}, T{}, T{}};
    UNROLL for (int e = 0; e < 6; ++e) B.e[e] = mat<T>{};
    for (int which = 0; which < 2; ++which) {
        Family<T> f = family(p.directions, p.n, i, which, t.F);
        T e = k1 * exp(k2 * f.stretch * f.stretch), w4 = e * f.stretch;
        T w44 = f.stretch > 0 ? e * (1 + 2 * k2 * f.stretch * f.stretch) : T{}, c[4];
        UNROLL for (int a = 1; a < 4; ++a) c[a] = dot(t.D[a], f.rest);
        c[0] = -(c[1] + c[2] + c[3]);
        UNROLL for (int a = 0; a < 4; ++a) impulse[a] = impulse[a] + (-2 * p.h * volume * w4 * c[a]) * f.now;
        UNROLL for (int edge = 0; edge < 6; ++edge) {
            T share = k * c[edge_first(edge)] * c[edge_second(edge)];
            add_identity(B.e[edge], 2 * share * w4);
            add_outer(B.e[edge], (4 * share * w44) * f.now, f.now);
        }
    }
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct FibresEnergy {
    int n;                    // elements
    const int* tets;          // (n, 4)
    const real* x;            // (nodes, 3) [m]
    const local* gradients;   // (9, n) [1/m]
    const local* volume;      // (n,) [m3]
    const local* constants;   // (2, n)
    const local* directions;  // (6, n)
    local* energy;            // (n,) out: V W [J]
};

KERNEL(energy, FibresEnergy) {
    typedef exact_number T;  // as that of hyperelastic.cu
    index tet[4];
    Tetrahedron<T> t = element_at<T>(p, i, tet);
    T k1 = at_items(p.constants, i), k2 = at_items(p.constants + p.n, i), W = T{};
    for (int which = 0; which < 2; ++which) {
        T y = family(p.directions, p.n, i, which, t.F).stretch, z = k2 * y * y;
        const entry<T> few = single<T> ? (entry<T>)1e-3 : (entry<T>)1e-7;
        T quotient = z > few ? (exp(z) - 1) / (z + (entry<T>)1e-37) : 1 + (entry<T>)0.5 * z;  // (e^z - 1) / z
        W += (entry<T>)0.5 * k1 * y * y * quotient;
    }
    put(p.energy, i, (local_number)(at_items(p.volume, i) * W));
}
