// SPDX-License-Identifier: MIT
// Corotational linear tetrahedra (formulas: corotational.py).
#define WIDE
#include "corotational.cuh"

struct CorotationalElements {
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
    local* nodal_impulse;                // (n, 4, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

KERNEL(elements, CorotationalElements) {
    index tet[4];
    get_item_row(p.tets, i, tet);
    local_mat3 g = rest_gradients(p.gradients, p.n, i);
    local_mat3 F = gradient(p.x, tet, g), G = gradient(p.v, tet, g);
    quaternion<local_number> q = nearest_quaternion(F);
    local_mat3 R = rotation_matrix(q), Rt = transposed(R);
    local_mat3 S = mul(Rt, F), T = mul(Rt, G);

    local_number k = at_items(p.stiffness_coefficient, i), lambda = at_items(p.lame, i), mu = at_items(p.lame + p.n, i);
    local_mat3 P = mul(R, hooke(S, T, p.h, k, lambda, mu));
    put_impulses(p.nodal_impulse, i, p.n, P, g);
    local_number w = sqrt(k * mu), ratio = lambda / mu;
    put_scaled_gradients(p.scaled_gradients, i, p.n, R, g, w, ratio);
    const local_number wxyz[4] = {q.w, q.x, q.y, q.z};
    put_row(p.quaternion, i, p.n, wxyz);
}

struct CorotationalForces {
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

// The forces of `elements` alone, without what A is made of.
KERNEL(forces, CorotationalForces) {
    index tet[4];
    local_number near[4];
    get_item_row(p.tets, i, tet);
    for (int k = 0; k < 4; ++k) near[k] = at(p.quaternion, 4 * i + k);
    local_mat3 g = rest_gradients(p.gradients, p.n, i), F = gradient(p.x, tet, g);
    quaternion<local_number> q = nearest_quaternion(F, {near[0], near[1], near[2], near[3]});
    local_mat3 R = rotation_matrix(q), Rt = transposed(R), S = mul(Rt, F), T = mul(Rt, gradient(p.v, tet, g));
    local_number k = at_items(p.stiffness_coefficient, i), lambda = at_items(p.lame, i), mu = at_items(p.lame + p.n, i);
    put_impulses(p.nodal_impulse, i, p.n, mul(R, hooke(S, T, p.h, k, lambda, mu)), g);
    put_row(p.quaternion, i, p.n, {q.w, q.x, q.y, q.z});
}

struct CorotationalEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* lame;       // (2, n) lambda V, mu V [Pa m3]
    local* energy;           // (n,) out: V (mu |S - I|^2 + lambda / 2 tr(S - I)^2), S = R^T F [J]
};

// In single precision S - I would leave a stiff element the rounding of F.
KERNEL(energy, CorotationalEnergy) {
    typedef exact_number T;
    index tet[4];
    get_item_row(p.tets, i, tet);
    mat<T> F = gradient(p.x, tet, as<T>(rest_gradients(p.gradients, p.n, i)));
    mat<T> S = mul(transposed(nearest_rotation(F)), F);
    T square = T{}, dilation = trace(S) - 3;
    for (int k = 0; k < 9; ++k) {
        T e = k % 4 == 0 ? S.m[k] - 1 : S.m[k];
        square += e * e;
    }
    T energy = at_items(p.lame + p.n, i) * square + (entry<T>)0.5 * at_items(p.lame, i) * dilation * dilation;
    put(p.energy, i, (local_number)energy);
}
