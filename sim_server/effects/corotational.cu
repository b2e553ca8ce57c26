// SPDX-License-Identifier: MIT
// Corotational linear tetrahedra (formulas: corotational.py).
#define WIDE
#include "polar.cuh"
#include "together.cuh"

struct Elements {
    int n;                    // elements
    const int* tets;          // (n, 4) nodes
    const real* x;            // (nodes, 3) positions [m]
    const real* v;            // (nodes, 3) world.drift [m/s]
    const local* gradients;   // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* lame;        // (2, n) lambda V, mu V [Pa m3]
    const local* stiffening;  // (n,) h (c + beta) [s2], c world.reach, beta the Rayleigh damping of the stiffness
    local h;                  // world.impulse: the time step in backward Euler [s]
    local* turn;              // (n, 4) out: unit quaternion of the nearest rotation of F, w first
    local* spread;            // (n, 4, 4) out: g_a = sqrt(h (c + beta) mu V) R grad N_a, and lambda / mu
    local* push;              // (n, 4, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

INLINE local_mat3 rest_gradients(const local* gradients, int n, index i) {
    local_mat3 g;
    for (int k = 0; k < 9; ++k) g.m[k] = at(gradients, k * n + i);
    return g;
}

// Gradient of a nodal field over the element: its differences in the field's precision.
INLINE local_mat3 gradient(const real* field, const index (&tet)[4], const local_mat3& g) {
    vec3 u = load3(field, tet[0]);
    return outer3(as<local_number>(load3(field, tet[1]) - u), as<local_number>(load3(field, tet[2]) - u),
                  as<local_number>(load3(field, tet[3]) - u), g);
}

KERNEL(elements, Elements) {
    index tet[4];
    get_row(p.tets, i, tet);
    local_mat3 g = rest_gradients(p.gradients, p.n, i);
    local_mat3 F = gradient(p.x, tet, g), G = gradient(p.v, tet, g);
    quaternion<local_number> q = nearest_quaternion(F);
    local_mat3 R = rotation_matrix(q), Rt = transposed(R);
    local_mat3 S = mul(Rt, F), T = mul(Rt, G);

    // Stress of h (strain) + h (c + beta) (strain rate), times V
    local_number k = at(p.stiffening, i), lambda = at(p.lame, i), mu = at(p.lame, p.n + i);
    local h = p.h;
    local_number pressure = lambda * (h * (trace(S) - 3) + k * trace(T));
    local_number xx = 2 * mu * (h * (S.m[0] - 1) + k * T.m[0]) + pressure;
    local_number yy = 2 * mu * (h * (S.m[4] - 1) + k * T.m[4]) + pressure;
    local_number zz = 2 * mu * (h * (S.m[8] - 1) + k * T.m[8]) + pressure;
    local_number xy = mu * (h * (S.m[1] + S.m[3]) + k * (T.m[1] + T.m[3]));
    local_number xz = mu * (h * (S.m[2] + S.m[6]) + k * (T.m[2] + T.m[6]));
    local_number yz = mu * (h * (S.m[5] + S.m[7]) + k * (T.m[5] + T.m[7]));
    local_mat3 P = mul(R, symmetric(xx, xy, xz, yy, yz, zz));  // forces -P grad N_a
    local_vec3 f1 = mul(P, row(g, 0)), f2 = mul(P, row(g, 1)), f3 = mul(P, row(g, 2)), f0 = f1 + f2 + f3;
    const local_number push[12] = {f0.x, f0.y, f0.z, -f1.x, -f1.y, -f1.z, -f2.x, -f2.y, -f2.z, -f3.x, -f3.y, -f3.z};
    put_row(p.push, i, p.n, push);

    local_number w = sqrt(k * mu), ratio = lambda / mu;
    local_vec3 g1 = w * mul(R, row(g, 0)), g2 = w * mul(R, row(g, 1)), g3 = w * mul(R, row(g, 2));
    local_vec3 g0 = -(g1 + g2 + g3);
    const local_number spread[16] = {g0.x, g0.y, g0.z, ratio, g1.x, g1.y, g1.z, ratio,
                                     g2.x, g2.y, g2.z, ratio, g3.x, g3.y, g3.z, ratio};
    put_row(p.spread, i, p.n, spread);
    const local_number turn[4] = {q.w, q.x, q.y, q.z};
    put_row(p.turn, i, p.n, turn);
}

struct Energy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* lame;       // (2, n) lambda V, mu V [Pa m3]
    local* energy;           // (n,) out: V (mu |S - I|^2 + lambda / 2 tr(S - I)^2), S = R^T F [J]
};

KERNEL(energy, Energy) {
    index tet[4];
    get_row(p.tets, i, tet);
    local_mat3 F = gradient(p.x, tet, rest_gradients(p.gradients, p.n, i));
    local_mat3 S = mul(transposed(nearest_rotation(F)), F);
    local_number square = local_number{}, dilation = trace(S) - 3;
    for (int k = 0; k < 9; ++k) {
        local_number e = k % 4 == 0 ? S.m[k] - 1 : S.m[k];
        square += e * e;
    }
    put(p.energy, i, at(p.lame, p.n + i) * square + (local)0.5 * at(p.lame, i) * dilation * dilation);
}
