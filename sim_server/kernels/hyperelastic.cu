// SPDX-License-Identifier: MIT
// Tetrahedra of a law W(I1, I2, J), by MJED (formulas: sim_server/effects/_hyperelastic.py). LAW is its text, effects/<law>.cuh.
#define WIDE
#include "hyperelastic.cuh"
#include "hyperelastic_element.cuh"
#include LAW

struct HyperelasticElements {
    int n;                               // elements
    int projection;                      // of the tangent
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) what the tangent is applied to [m/s]
    const local* gradients;              // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* volume;                 // (n,) [m3]
    const local* constants;              // (CONSTANTS, n) of the law
    const local* floor;                  // (n,) J below which the law goes on as a parabola, 0: J <= 0 is refused
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    local h;                             // factor of the force [s]
    const double* clock;                 // (1,) [s]
    double* refused;                     // (n, 2) in, out: when the element was first refused [s], -1: never; its J then
    local* corners;                      // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa [kg]
    local* edges;                        // (6, n, 9) out: factor K_ab, a < b [kg]
};

KERNEL(elements, HyperelasticElements) {
    index tet[4];
    local_vec3 v[3];
    Tetrahedron<local_number> t = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    local_number c[CONSTANTS], volume = at_items(p.volume, i), floor = at_items(p.floor, i), k = volume * at_items(p.stiffness_coefficient, i);
    constants_at(p, i, c);
    mat<local_number> left = mul(t.F, transposed(t.F));
    Invariants<local_number> q = invariants<HAS>(left, t.J);
    Slopes<local_number> w = slopes(c, q, floor);

    local_vec3 impulse[4];
    forces<HAS>(w, q, left, t, -p.h * volume, impulse);
    put_element<HAS, REFUSES>(p, i, t, q, w, left, k, floor, v, impulse);
}

struct HyperelasticForces {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) positions [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* constants;  // (CONSTANTS, n) of the law
    const local* floor;      // (n,)
    local h;                 // factor of the force [s]
    const double* clock;     // (1,) [s]
    double* refused;         // (n, 2) in, out
    local* impulses;         // (4, n, 3) out: h f_a [N s]
};

// The forces of `elements` alone, without a tangent.
KERNEL(forces, HyperelasticForces) {
    index tet[4];
    Tetrahedron<local_number> t = element_at(p, i, tet);
    local_number c[CONSTANTS], floor = at_items(p.floor, i);
    constants_at(p, i, c);
    mat<local_number> left = mul(t.F, transposed(t.F));
    Invariants<local_number> q = invariants<HAS>(left, t.J);
    local_vec3 impulse[4];
    forces<HAS>(slopes(c, q, floor), q, left, t, -p.h * at_items(p.volume, i), impulse);
    put_impulses<REFUSES>(p, i, t.J, floor, impulse);
}

struct HyperelasticEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* constants;  // (CONSTANTS, n)
    const local* floor;      // (n,)
    local* energy;           // (n,) out: V W [J]; NaN where the law is not defined
};

// In single precision terms as I1 - 3 and ln J, which nearly cancel, would leave a stiff element the rounding of its moduli.
KERNEL(energy, HyperelasticEnergy) {
    index tet[4];
    Tetrahedron<exact_number> t = element_at<exact_number>(p, i, tet);
    exact_number c[CONSTANTS], floor = at_items(p.floor, i);
    constants_at(p, i, c);
    exact_number W = density(c, invariants<HAS>(mul(t.F, transposed(t.F)), t.J), floor);
    if constexpr (REFUSES) W = t.J <= 0 && floor == 0 ? no_number<exact_number>() : W;
    put(p.energy, i, (local_number)(at_items(p.volume, i) * W));
}
