// SPDX-License-Identifier: MIT
// Damage of corotational tetrahedra (formulas: damage.py).
#define WIDE
#include "turning_strain.cuh"

// Elastic moduli of an element [Pa].
template <class T> struct Moduli { T lambda, mu; };

template <class P> INLINE Moduli<local_number> moduli_at(const P& p, index i) {
    return {at_items(p.lame, i), at_items(p.shear, i)};
}

// strain : C : strain [Pa]
template <class T> INLINE T twice_energy(const symmetric6<T>& strain, Moduli<T> c) {
    const T dilation = trace(strain);
    return 2 * c.mu * contraction(strain, strain) + c.lambda * dilation * dilation;
}

// Equivalent strain: in a bar under tension it is that of the bar.
template <class T> INLINE T equivalent(const symmetric6<T>& strain, Moduli<T> c, int tension) {
    if (!tension) return sqrt(twice_energy(strain, c) * (c.lambda + c.mu) / (c.mu * (3 * c.lambda + 2 * c.mu)));
    T a[6], zero = T{}, one = T{} + 1;
    vec<T> v[3] = {{one, zero, zero}, {zero, one, zero}, {zero, zero, one}};
    UNROLL for (int k = 0; k < 6; ++k) a[k] = strain.m[k];
    eigen3(a, v);
    const T x = larger(a[0], zero), y = larger(a[3], zero), z = larger(a[5], zero);
    return sqrt(x * x + y * y + z * z);
}

// first, scale: strain at which damage begins, and over which the stress falls to 1 / e.
template <class T> INLINE T damage_of(T strain, T first, T scale, T most) {
    const T over = larger(strain - first, T{});
    return smaller(1 - first / (first + over) * exp(-over / scale), most);
}

// Damage of an element at a strain, and with what it remembers.
template <class P> INLINE local_number damage_at(const P& p, index i, local_number strain) {
    strain = larger(at_items(p.largest, i), strain);
    const local_number found = damage_of(strain, at_items(p.limits, i), at_items(p.limits + p.n, i), at_items(p.most, i));
    return larger(at_items(p.least, i), found);
}

struct DamageHistory {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) where the last step ended [m]
    const local* gradients;  // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const real* free;        // (nodes,) 1, or 0 at fixed nodes and in a frozen body
    const int* watched;      // (n,) a node of the element's body that is free unless the body is frozen
    const local* lame;       // (n,) lambda [Pa]
    const local* shear;      // (n,) mu [Pa]
    const local* limits;     // (2, n) strain at which damage begins, and over which the stress falls to 1 / e
    const local* most;       // (n,) largest damage
    int tension;             // 1: principal strains above 0 count, 0: the energy
    local* last;             // (4, n) in, out: limits, lambda and mu with which the last step ended, as they are now
    local* largest;          // (1, n) in, out: largest equivalent strain so far
    local* least;            // (1, n) in, out: damage so far where the limits have changed since
};

// Once a step.
KERNEL(advance, DamageHistory) {
    typedef local_number T;
    index tet[4];
    const long long n = p.n;
    const T first = at_items(p.last, i), scale = at_items(p.last + n, i), first_now = at_items(p.limits, i), scale_now = at_items(p.limits + n, i);
    const Moduli<T> c = {at_items(p.last + 2 * n, i), at_items(p.last + 3 * n, i)}, c_now = moduli_at(p, i);
    const T before = at_items(p.largest, i), now = equivalent(turned_element_at(p, i, tet).strain, c, p.tension);
    const T largest = is_live(p, i) ? larger(before, now) : before, least = at_items(p.least, i);
    auto changed = (first != first_now) | (scale != scale_now);
    put(p.largest, i, largest);
    put(p.least, i, changed ? larger(least, damage_of(largest, first, scale, at_items(p.most, i))) : least);
    put(p.last, i, first_now);
    put(p.last + n, i, scale_now);
    put(p.last + 2 * n, i, c_now.lambda);
    put(p.last + 3 * n, i, c_now.mu);
}

struct DamageElements {
    int n;                               // elements
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) what the tangent is applied to: world.damping_velocity [m/s]
    const local* gradients;              // (9, n) [1/m]
    const local* volume;                 // (n,) [m3]
    const local* lame;                   // (n,) [Pa]
    const local* shear;                  // (n,) [Pa]
    const local* limits;                 // (2, n) as above
    const local* most;                   // (n,) largest damage
    int tension;
    local h;                             // factor of the force [s]
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    const local* largest;                // (1, n) largest equivalent strain as the step began
    const local* least;                  // (1, n) damage that there is whatever the strain
    local* corners;                      // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa [kg]
    local* edges;                        // (6, n, 9) out: factor K_ab, a < b [kg]
};

// What damage takes from force and stiffness of the elastic element.
KERNEL(elements, DamageElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3], impulse[4], D[4];
    TurnedElement<T> e = turned_element_at(p, i, tet);
    field_edges(p.v, tet, v);
    Moduli<T> c = moduli_at(p, i);
    const T damage = damage_at(p, i, equivalent(e.strain, c, p.tension));
    const T lost = -damage * at_items(p.volume, i), factor = lost * at_items(p.stiffness_coefficient, i);
    symmetric6<T> stress = e.strain;
    UNROLL for (int k = 0; k < 6; ++k) stress.m[k] *= 2 * p.h * lost * c.mu;
    add_to_diagonal(stress, p.h * lost * c.lambda * trace(e.strain));
    impulses_of(e, mul(e.R, whole(stress)), impulse);
    world_gradients(e, D);
    Blocks6<T> B = isotropic_blocks(D, factor * c.lambda, factor * c.mu);
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct DamageEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* lame;       // (n,) [Pa]
    const local* shear;      // (n,) [Pa]
    const local* limits;     // (2, n)
    const local* most;       // (n,)
    int tension;
    const local* largest;    // (1, n)
    const local* least;      // (1, n)
    local* energy;           // (n,) out: -V damage (mu |strain|^2 + lambda / 2 tr(strain)^2) at the end of the step [J]
};

KERNEL(energy, DamageEnergy) {
    typedef local_number T;
    index tet[4];
    symmetric6<T> strain = turned_element_at(p, i, tet).strain;
    Moduli<T> c = moduli_at(p, i);
    T damage = damage_at(p, i, equivalent(strain, c, p.tension));
    put(p.energy, i, -(local)0.5 * at_items(p.volume, i) * damage * twice_energy(strain, c));
}
