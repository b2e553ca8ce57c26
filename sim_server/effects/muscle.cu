// SPDX-License-Identifier: MIT
// Fibres of tetrahedra that contract by themselves (formulas: muscle.py). What stands in A is semi-definite: nothing is projected.
#define WIDE
#include "hyperelastic.cuh"

struct MuscleElements {
    int n;                               // elements
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) what the tangent is applied to [m/s]
    const local* gradients;              // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* volume;                 // (n,) [m3]
    const local* constants;              // (7, n) stress [Pa], activation, period [s], phase, duty, optimum, width [-]
    const local* directions;             // (3, n) at rest, of unit length
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    const double* clock;                 // (1,) time at the start of the step [s]
    double ahead;                        // from there to the time of the pulse [s]
    local h;                             // factor of the force [s]
    local* corners;                      // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa [kg]
    local* edges;                        // (6, n, 9) out: factor K_ab, a < b [kg]
    local* forces;                       // (4, n, 3) out: f_a [N]
};

// The part of a period that has passed at a time, in double precision however long steps have run.
#if defined(__CUDACC_RTC__)
INLINE local_number passed(double time, local_number period, local_number phase) {
    double periods = time / (double)period - (double)phase;
    return (local_number)(periods - floor(periods));
}
#else
INLINE local_number passed(double time, local_number period, local_number phase) {
    local_number part;
    for (int k = 0; k < LANES; ++k) {
        double periods = time / (double)period[k] - (double)phase[k];
        part[k] = (local)(periods - std::floor(periods));
    }
    return part;
}
#endif

// 16 s^2 (1 - s)^2 in the part `duty` of a period; 1 without a period.
INLINE local_number pulse(double time, local_number period, local_number phase, local_number duty) {
    const local_number one = local_number{} + 1;
    local_number s = smaller(passed(time, period > 0 ? period : one, phase) / duty, one), q = s * (1 - s);
    return period > 0 ? 16 * q * q : one;
}

KERNEL(elements, MuscleElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3], impulse[4];
    Tetrahedron<T> t = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    T c[7];
    constants_at(p, i, c);
    const vec<T> rest = {at_items(p.directions, i), at_items(p.directions + p.n, i), at_items(p.directions + 2 * p.n, i)};
    const vec<T> now = mul(t.F, rest);
    const T stretch = sqrt(dot(now, now)), inverse = 1 / larger(stretch, T{} + (entry<T>)1e-6);
    const vec<T> along = inverse * now;
    const T wide = c[6] > 0 ? 1 / (c[6] + (entry<T>)1e-37) : T{}, off = (stretch - c[5]) * wide;
    const T most = c[0] * c[1] * pulse(p.clock[0] + p.ahead, c[2], c[3], c[4]);
    const T tension = most * larger(1 - off * off, T{});
    const T slope = tension > 0 ? larger(-2 * most * off * wide, T{}) : T{};  // the descending branch is left out
    const T volume = at_items(p.volume, i), k = volume * at_items(p.stiffness_coefficient, i), across = tension * inverse;
    T share[4];
    Blocks6<T> B;
    UNROLL for (int a = 1; a < 4; ++a) share[a] = dot(t.D[a], rest);
    share[0] = -(share[1] + share[2] + share[3]);
    UNROLL for (int a = 0; a < 4; ++a) {
        const vec<T> force = (-volume * tension * share[a]) * along;
        put_row(p.forces + 3 * (long long)p.n * a, i, p.n, {force.x, force.y, force.z});
        impulse[a] = p.h * force;
    }
    UNROLL for (int e = 0; e < 6; ++e) {
        const T both = k * share[edge_first(e)] * share[edge_second(e)];
        B.e[e] = mat<T>{};
        add_identity(B.e[e], both * across);
        add_outer(B.e[e], (both * (slope - across)) * along, along);
    }
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}
