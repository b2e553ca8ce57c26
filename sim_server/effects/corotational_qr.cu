// SPDX-License-Identifier: MIT
// Corotational linear tetrahedra with the rotation of their first edge and first face (formulas: corotational.py).
#define WIDE
#include "corotational.cuh"
#include "gram_schmidt.cuh"

struct CorotationalQrElements {
    int n;                               // elements
    const int* tets;                     // (n, 4) nodes
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) world.damping_velocity [m/s]
    const local* gradients;              // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* lame;                   // (2, n) lambda V, mu V [Pa m3]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2], c world.dx_dv, beta the Rayleigh damping of the stiffness
    local h;                             // world.force_coefficient: the time step in backward Euler [s]
    local* quaternion;                   // (n, 4) out: unit quaternion of the rotation, w first
    local* scaled_gradients;             // (n, 4, 4) out: g_a = sqrt(h (c + beta) mu V) R grad N_a, and lambda / mu
    local* nodal_impulse;                // (n, 4, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

// Rotation from the frame of edge 01 and face 012 at rest to the present one.
template <class T> INLINE mat<T> edge_face_rotation(const real* x, const index (&tet)[4], const mat<T>& g) {
    vec3 origin = load3(x, tet[0]);
    vec<T> first = as<T>(load3(x, tet[1]) - origin), second = as<T>(load3(x, tet[2]) - origin);
    // At rest: N_3 rises off the face, N_2 and N_3 are constant along the edge. In units of rest lengths no scale is special.
    vec<T> edge = cross(row(g, 1), row(g, 2));
    T per_volume = dot(row(g, 0), edge), scale = per_volume / sqrt(dot(edge, edge));  // 1 / length
    return rotation_between(unit(edge), unit(row(g, 2)), scale * first, scale * second);
}

KERNEL(elements, CorotationalQrElements) {
    index tet[4];
    get_item_row(p.tets, i, tet);
    local_mat3 g = rest_gradients(p.gradients, p.n, i);
    local_mat3 R = edge_face_rotation(p.x, tet, g), Rt = transposed(R);
    local_mat3 S = mul(Rt, gradient(p.x, tet, g)), T = mul(Rt, gradient(p.v, tet, g));
    local_number k = at_items(p.stiffness_coefficient, i), lambda = at_items(p.lame, i), mu = at_items(p.lame + p.n, i);
    put_impulses(p.nodal_impulse, i, p.n, mul(R, hooke(S, T, p.h, k, lambda, mu)), g);
    put_scaled_gradients(p.scaled_gradients, i, p.n, R, g, sqrt(k * mu), lambda / mu);
    quaternion<local_number> q = quaternion_of(R);
    put_row(p.quaternion, i, p.n, {q.w, q.x, q.y, q.z});
}

struct CorotationalQrEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* lame;       // (2, n) lambda V, mu V [Pa m3]
    local* energy;           // (n,) out: V (mu |e|^2 + lambda / 2 tr(e)^2), e the symmetric part of R^T F - I [J]
};

KERNEL(energy, CorotationalQrEnergy) {
    typedef exact_number T;  // as that of corotational.cu
    const entry<T> half = 0.5;
    index tet[4];
    get_item_row(p.tets, i, tet);
    mat<T> g = as<T>(rest_gradients(p.gradients, p.n, i));
    mat<T> S = mul(transposed(edge_face_rotation(p.x, tet, g)), gradient(p.x, tet, g));
    T xx = S.m[0] - 1, yy = S.m[4] - 1, zz = S.m[8] - 1, dilation = xx + yy + zz;
    T xy = S.m[1] + S.m[3], xz = S.m[2] + S.m[6], yz = S.m[5] + S.m[7];
    T square = xx * xx + yy * yy + zz * zz + half * (xy * xy + xz * xz + yz * yz);
    T energy = at_items(p.lame + p.n, i) * square + half * at_items(p.lame, i) * dilation * dilation;
    put(p.energy, i, (local_number)energy);
}
