// SPDX-License-Identifier: MIT
// Corotational linear tetrahedra with the tangent that includes the change of their rotations (formulas: corotational.py). What it
// adds to the usual tangent, for corners a and b, is [g_a]x E [g_b]x^T with E = R (sum e / (2 mu) u u^T) R^T, one E per element.
#define WIDE
#include "corotational_twist.cuh"

struct CorotationalExactElements {
    int n;                               // elements
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) world.damping_velocity [m/s]
    const local* gradients;              // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* lame;                   // (2, n) lambda V, mu V [Pa m3]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2], c world.dx_dv, beta the Rayleigh damping of the stiffness
    local h;                             // world.force_coefficient: the time step in backward Euler [s]
    local* quaternion;                   // (n, 4) out: unit quaternion of the nearest rotation of F, w first
    local* scaled_gradients;             // (n, 4, 4) out: g_a = sqrt(h (c + beta) mu V) R grad N_a, and lambda / mu
    local* twist;                        // (n, 6) out: upper triangle of E, positive semi-definite
    local* nodal_impulse;                // (n, 4, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

INLINE local_mat3 hooke_twists(const local_mat3& S, local_number lambda, local_number mu) {
    return twists(S, local_number{} + 1, lambda / mu * (trace(S) - 3) - 2);
}

// The stress of `hooke` and what E adds to it, which is of the spin of T.
INLINE local_mat3 exact_stress(const local_mat3& S, const local_mat3& T, const local_mat3& E, local h, local_number k,
                               local_number lambda, local_number mu) {
    local_mat3 P = hooke(S, T, h, k, lambda, mu);
    add_spin_stress(P, T, E, k * mu);
    return P;
}

KERNEL(elements, CorotationalExactElements) {
    index tet[4];
    get_item_row(p.tets, i, tet);
    local_mat3 g = rest_gradients(p.gradients, p.n, i);
    local_mat3 F = gradient(p.x, tet, g), G = gradient(p.v, tet, g);
    quaternion<local_number> q = nearest_quaternion(F);
    local_mat3 R = rotation_matrix(q), Rt = transposed(R);
    local_mat3 S = mul(Rt, F), T = mul(Rt, G);

    local_number k = at_items(p.stiffness_coefficient, i), lambda = at_items(p.lame, i), mu = at_items(p.lame + p.n, i);
    local_mat3 E = hooke_twists(S, lambda, mu), P = exact_stress(S, T, E, p.h, k, lambda, mu);
    put_impulses(p.nodal_impulse, i, p.n, mul(R, P), g);
    put_scaled_gradients(p.scaled_gradients, i, p.n, R, g, sqrt(k * mu), lambda / mu);
    E = mul(R, mul(E, Rt));
    put_row(p.twist, i, p.n, {E.m[0], E.m[1], E.m[2], E.m[4], E.m[5], E.m[8]});
    put_row(p.quaternion, i, p.n, {q.w, q.x, q.y, q.z});
}

struct CorotationalExactForces {
    int n;                               // elements
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) world.damping_velocity [m/s]
    const local* gradients;              // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* lame;                   // (2, n) lambda V, mu V [Pa m3]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2]
    local h;                             // world.force_coefficient [s]
    local* quaternion;                   // (n, 4) in, out: of the last rotation, of this one
    local* nodal_impulse;                // (n, 4, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

// The forces of `elements` alone, with the damping of the stiffness, without what A is made of.
KERNEL(forces, CorotationalExactForces) {
    index tet[4];
    local_number near[4];
    get_item_row(p.tets, i, tet);
    for (int k = 0; k < 4; ++k) near[k] = at(p.quaternion, 4 * i + k);
    local_mat3 g = rest_gradients(p.gradients, p.n, i), F = gradient(p.x, tet, g);
    quaternion<local_number> q = nearest_quaternion(F, {near[0], near[1], near[2], near[3]});
    local_mat3 R = rotation_matrix(q), Rt = transposed(R), S = mul(Rt, F), T = mul(Rt, gradient(p.v, tet, g));
    local_number k = at_items(p.stiffness_coefficient, i), lambda = at_items(p.lame, i), mu = at_items(p.lame + p.n, i);
    local_mat3 P = exact_stress(S, T, hooke_twists(S, lambda, mu), p.h, k, lambda, mu);
    put_impulses(p.nodal_impulse, i, p.n, mul(R, P), g);
    put_row(p.quaternion, i, p.n, {q.w, q.x, q.y, q.z});
}
