// SPDX-License-Identifier: MIT
// Springs between two nodes (formulas: mass_spring.py).
#define WIDE
#include "mat3.cuh"
#include "coalesced_io.cuh"

struct Springs {
    int n;                               // elements
    const int* ends;                     // (n, 2) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) world.damping_velocity [m/s]
    const local* stiffness;              // (n,) k [N/m]
    const local* length;                 // (n,) l0 [m]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2], c world.dx_dv, beta the Rayleigh damping of the stiffness
    local h;                             // world.force_coefficient: the time step in backward Euler [s]
    local* tangent;                      // (n, 4) out: g and d; h (c + beta) K = g g^T + d I on the diagonal, its negative off it
    local* nodal_impulse;                // (n, 3) out: h f + h (c + beta) (K v) of the first end, the second has its negative [N s]
};

// From the first end to the second: the difference of a nodal field in the field's precision.
template <class T = local_number> INLINE vec<T> difference(const real* field, const int* ends, index i) {
    return as<T>(load3(field, at(ends, 2 * i + 1)) - load3(field, at(ends, 2 * i)));
}

// 1 / l; finite where the ends meet: the spring then has no direction and neither pulls nor pushes.
INLINE local_number inverse(local_number l) { return 1 / (l + (local)1e-37); }

KERNEL(springs, Springs) {
    local_vec3 d = difference(p.x, p.ends, i), dv = difference(p.v, p.ends, i);
    local_number k = at_items(p.stiffness, i), l0 = at_items(p.length, i), c = at_items(p.stiffness_coefficient, i), l = sqrt(dot(d, d));
    local_vec3 u = inverse(l) * d;
    local_number across = larger(1 - l0 * inverse(l), local_number{});  // under compression 0: K has no negative part
    local_vec3 g = sqrt(c * k * (1 - across)) * u;
    local_number all = c * k * across;
    local_vec3 f = (p.h * k * (l - l0)) * u + dot(g, dv) * g + all * dv;
    put_row(p.tangent, i, p.n, {g.x, g.y, g.z, all});
    put_row(p.nodal_impulse, i, p.n, {f.x, f.y, f.z});
}

struct MassSpringEnergy {
    int n;                   // elements
    const int* ends;         // (n, 2)
    const real* x;           // (nodes, 3) [m]
    const local* stiffness;  // (n,) [N/m]
    const local* length;     // (n,) [m]
    local* energy;           // (n,) out: k / 2 (l - l0)^2 [J]
};

KERNEL(energy, MassSpringEnergy) {
    typedef exact_number T;  // in single precision a stiff spring would have the rounding of its length
    vec<T> d = difference<T>(p.x, p.ends, i);
    T longer = sqrt(dot(d, d)) - at_items(p.length, i);
    put(p.energy, i, (local_number)((entry<T>)0.5 * at_items(p.stiffness, i) * longer * longer));
}
