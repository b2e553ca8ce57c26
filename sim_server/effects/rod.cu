// SPDX-License-Identifier: MIT
// Stretch and bending of rods, each a spring of a weighted sum of nodes (formulas: rod.py). rod_sums.cu gathers them.
#define WIDE
#include "mat3.cuh"
#include "coalesced_io.cuh"

struct Rods {
    int n;                               // elements: segments and bends
    int corners;                         // of each
    const int* nodes;                    // (n, corners)
    const real* weights;                 // (n, corners) W, of sum 0 [-] or [1/m]
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) world.damping_velocity [m/s]
    const local* stiffness;              // (n,) k: of segments [N/m], of bends [N m]
    const local* length;                 // (n,) |d| without force: of segments [m], of bends [-]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2], c world.dx_dv, beta the Rayleigh damping of the stiffness
    local h;                             // world.force_coefficient: the time step in backward Euler [s]
    local* tangent;                      // (n, 4) out: g and e; h (c + beta) K = W_a W_b (g g^T + e I)
    local* nodal_impulse;                // (n, 3) out: h f - h (c + beta) K v of a corner, over its W
};

// sum of W times a nodal field: weights of sum 0, so that differences from the first corner do
template <class T = local_number, class P> INLINE vec<T> weighted(const P& p, const real* field, index i) {
    const vec3 first = load3(field, at(p.nodes, p.corners * i));
    vec3 sum = {number{}, number{}, number{}};
    for (int a = 1; a < p.corners; ++a)
        sum = sum + at(p.weights, p.corners * i + a) * (load3(field, at(p.nodes, p.corners * i + a)) - first);
    return as<T>(sum);
}

// 1 / l; finite where d vanishes: it then has no direction.
INLINE local_number inverse(local_number l) { return 1 / (l + (local)1e-37); }

KERNEL(springs, Rods) {
    local_vec3 d = weighted(p, p.x, i), rate = weighted(p, p.v, i);
    local_number k = at_items(p.stiffness, i), l0 = at_items(p.length, i), c = at_items(p.stiffness_coefficient, i), l = sqrt(dot(d, d));
    local_vec3 u = inverse(l) * d;
    local_number across = larger(1 - l0 * inverse(l), local_number{});
    local_vec3 g = sqrt(c * k * (1 - across)) * u;
    local_number all = c * k * across;
    local_vec3 f = (p.h * k * (l - l0)) * u + dot(g, rate) * g + all * rate;
    put_row(p.tangent, i, p.n, {g.x, g.y, g.z, all});
    put_row(p.nodal_impulse, i, p.n, {-f.x, -f.y, -f.z});
}

struct RodEnergy {
    int n;                   // elements
    int corners;             // of each
    const int* nodes;        // (n, corners)
    const real* weights;     // (n, corners)
    const real* x;           // (nodes, 3) [m]
    const local* stiffness;  // (n,) [N/m] or [N m]
    const local* length;     // (n,) [m] or [-]
    local* energy;           // (n,) out: k / 2 (|d| - d0)^2 [J]
};

KERNEL(energy, RodEnergy) {
    typedef exact_number T;  // as that of mass_spring.cu
    vec<T> d = weighted<T>(p, p.x, i);
    T longer = sqrt(dot(d, d)) - at_items(p.length, i);
    put(p.energy, i, (local_number)((entry<T>)0.5 * at_items(p.stiffness, i) * longer * longer));
}
