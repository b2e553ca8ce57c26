// SPDX-License-Identifier: MIT
// Pore pressure in tetrahedra (formulas: poroelasticity.py).
#define WIDE
#include "turning_strain.cuh"

struct PoreHistory {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) where the last step ended [m]
    const local* gradients;  // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const real* free;        // (nodes,) 1, or 0 at fixed nodes and in a frozen body
    const int* watched;      // (n,) a node of the element's body that is free unless the body is frozen
    const real* coupling;    // (n,) alpha M [Pa]
    real* jacobian;          // (1, n) in, out: J at the end of the step before, of this one
    real* inner;             // (1, n) in, out: pressure as the last step began, as it ended [Pa]
};

// Once a step.
KERNEL(advance, PoreHistory) {
    index tet[4];
    const number before = at_items(p.jacobian, i), J = (number)element_at(p, i, tet).J, now = is_live(p, i) ? J : before;
    put(p.inner, i, at_items(p.inner, i) + at_items(p.coupling, i) * (before - now));
    put(p.jacobian, i, now);
}

// Mean of a nodal field in an element.
INLINE number mean_of(const real* field, const index (&tet)[4]) {
    number sum = number{};
    UNROLL for (int a = 0; a < 4; ++a) sum += at(field, tet[a]);
    return (real)0.25 * sum;
}

struct PoreRest {
    int n;              // elements
    const int* tets;    // (n, 4) nodes
    const real* mean;   // (nodes,) of the elements at a node, 0 where it is drained [Pa]
    const real* inner;  // (1, n) pressure [Pa]
    real* rest;         // (n,) out: what the means do not have of it [Pa]
};

KERNEL(rest_of, PoreRest) {
    index tet[4];
    get_item_row(p.tets, i, tet);
    put(p.rest, i, at_items(p.inner, i) - mean_of(p.mean, tet));
}

struct PoreSpread {
    int n;                 // elements
    const int* tets;       // (n, 4) nodes
    const real* pressure;  // (nodes,) before the flow [Pa]
    const real* flowed;    // (nodes,) after it [Pa]
    const real* rest;      // (n,) what the means of nodes do not have of the pressure [Pa]
    const real* mean;      // (nodes,) of `rest`, 0 where it is drained [Pa]
    const real* between;   // (n,) part of what both do not have that flows in a step, between neighbours and to drained nodes
    const real* free;      // (nodes,) 1, or 0 at fixed nodes and in a frozen body
    const int* watched;    // (n,) a node of the element's body that is free unless the body is frozen
    real* inner;           // (1, n) in, out: pressure before and after the flow [Pa]
};

// Once a step, after the flow between nodes; in a frozen body nothing flows.
KERNEL(spread, PoreSpread) {
    index tet[4];
    get_item_row(p.tets, i, tet);
    const number flow = mean_of(p.flowed, tet) - mean_of(p.pressure, tet);
    const number blind = at_items(p.rest, i) - mean_of(p.mean, tet), before = at_items(p.inner, i);
    put(p.inner, i, is_live(p, i) ? before + flow - at_items(p.between, i) * blind : before);
}

// Pressure of an element at J, before the fluid flows [Pa].
template <class P> INLINE local_number pressure_of(const P& p, index i, local_number J) {
    return (local_number)(at_items(p.inner, i) + at_items(p.coupling, i) * (at_items(p.jacobian, i) - (number)J));
}

struct PoreElements {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) positions [m]
    const real* v;           // (nodes, 3) what the tangent is applied to: world.predictor [m/s]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* biot;       // (n,) alpha
    const real* coupling;    // (n,) alpha M [Pa]
    const local* stiffness;  // (n,) alpha^2 M [Pa]
    local h;                 // factor of the force [s]
    local tangent;           // factor of the tangent [s2]
    const real* jacobian;    // (1, n) J as the step began
    const real* inner;       // (1, n) pressure there [Pa]
    local* corners;          // (4, n, 9) out: h f_a - tangent (K v)_a [N s], upper triangle of tangent K_aa [kg]
    local* edges;            // (6, n, 9) out: tangent K_ab, a < b [kg]
};

KERNEL(elements, PoreElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3], impulse[4];
    Tetrahedron<T> t = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    const T volume = at_items(p.volume, i), push = p.h * volume * at_items(p.biot, i) * pressure_of(p, i, t.J);
    const T k = p.tangent * volume * at_items(p.stiffness, i);
    UNROLL for (int a = 0; a < 4; ++a) impulse[a] = push * t.area[a];
    Blocks6<T> B;
    UNROLL for (int e = 0; e < 6; ++e) {
        B.e[e] = mat<T>{};
        add_outer(B.e[e], k * t.area[edge_first(e)], t.area[edge_second(e)]);
    }
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct PoreEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const real* coupling;    // (n,) alpha M [Pa]
    const real* storage;     // (n,) M [Pa]
    const real* jacobian;    // (1, n) J as the step began
    const real* inner;       // (1, n) pressure there [Pa]
    local* energy;           // (n,) out [J]
};

KERNEL(energy, PoreEnergy) {
    index tet[4];
    const local_number pressure = pressure_of(p, i, element_at(p, i, tet).J);
    put(p.energy, i, (local)0.5 * at_items(p.volume, i) * pressure * pressure / (local_number)at_items(p.storage, i));
}
