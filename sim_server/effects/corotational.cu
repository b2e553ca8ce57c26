// SPDX-License-Identifier: MIT
// Corotational linear tetrahedra (formulas: corotational.py).
#define WIDE
#include "polar.cuh"

struct Elements {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) positions [m]
    const real* v;           // (nodes, 3) velocities [m/s]
    const real* gradients;   // (n, 3, 3) rest gradients of the shape functions of nodes 1, 2, 3 [1/m]
    const real* lame;        // (n, 2) lambda V, mu V [Pa m3]
    const real* stiffening;  // (n,) h (h + beta) [s2], beta the Rayleigh damping of the stiffness
    real h;                  // time step [s]
    real* rotation;          // (n, 3, 3) out: nearest rotation of F
    real* spread;            // (n, 4, 3) out: sqrt(h (h + beta) mu V) R grad N_a
    real* push;              // (n, 4, 3) out: h f_a + h (h + beta) (K v)_a [N s]
};

// Forces -(R s) grad N_a for a stress s (symmetric) in the material frame, V already in it.
INLINE void nodal_forces(real* out, index i, const mat3& R, const mat3& s, const mat3& g) {
    mat3 P = mul(R, s);
    vec3 f1 = mul(P, row(g, 0)), f2 = mul(P, row(g, 1)), f3 = mul(P, row(g, 2));
    store3(out, 4 * i, f1 + f2 + f3);
    store3(out, 4 * i + 1, -f1);
    store3(out, 4 * i + 2, -f2);
    store3(out, 4 * i + 3, -f3);
}

// Gradient of a nodal field over the element.
INLINE mat3 gradient(const real* field, const int* tets, index i, const mat3& g) {
    vec3 u = load3(field, at(tets, 4 * i));
    return outer3(load3(field, at(tets, 4 * i + 1)) - u, load3(field, at(tets, 4 * i + 2)) - u,
                  load3(field, at(tets, 4 * i + 3)) - u, g);
}

KERNEL(elements, Elements) {
    mat3 g = load9(p.gradients, i);
    mat3 F = gradient(p.x, p.tets, i, g), G = gradient(p.v, p.tets, i, g);
    mat3 R = nearest_rotation(F), Rt = transposed(R);
    mat3 S = mul(Rt, F), T = mul(Rt, G);

    // Stress of h (strain) + h (h + beta) (strain rate), times V
    number k = at(p.stiffening, i), h = constant(p.h), lambda = at(p.lame, 2 * i), mu = at(p.lame, 2 * i + 1);
    number pressure = lambda * (h * (trace(S) - 3) + k * trace(T));
    number xx = 2 * mu * (h * (S.m[0] - 1) + k * T.m[0]) + pressure;
    number yy = 2 * mu * (h * (S.m[4] - 1) + k * T.m[4]) + pressure;
    number zz = 2 * mu * (h * (S.m[8] - 1) + k * T.m[8]) + pressure;
    number xy = mu * (h * (S.m[1] + S.m[3]) + k * (T.m[1] + T.m[3]));
    number xz = mu * (h * (S.m[2] + S.m[6]) + k * (T.m[2] + T.m[6]));
    number yz = mu * (h * (S.m[5] + S.m[7]) + k * (T.m[5] + T.m[7]));
    nodal_forces(p.push, i, R, mat3{{xx, xy, xz, xy, yy, yz, xz, yz, zz}}, g);

    number w = sqrt(k * mu);
    vec3 g1 = w * mul(R, row(g, 0)), g2 = w * mul(R, row(g, 1)), g3 = w * mul(R, row(g, 2));
    store3(p.spread, 4 * i, -(g1 + g2 + g3));
    store3(p.spread, 4 * i + 1, g1);
    store3(p.spread, 4 * i + 2, g2);
    store3(p.spread, 4 * i + 3, g3);
    store9(p.rotation, i, R);
}

struct Energy {
    int n;                  // elements
    const int* tets;        // (n, 4)
    const real* x;          // (nodes, 3) [m]
    const real* gradients;  // (n, 3, 3) [1/m]
    const real* lame;       // (n, 2) lambda V, mu V [Pa m3]
    real* energy;           // (n,) out: V (mu |S - I|^2 + lambda / 2 tr(S - I)^2), S = R^T F [J]
};

KERNEL(energy, Energy) {
    mat3 F = gradient(p.x, p.tets, i, load9(p.gradients, i));
    mat3 S = mul(transposed(nearest_rotation(F)), F);
    number square = number{}, dilation = trace(S) - 3;
    for (int k = 0; k < 9; ++k) {
        number e = k % 4 == 0 ? S.m[k] - 1 : S.m[k];
        square += e * e;
    }
    put(p.energy, i, at(p.lame, 2 * i + 1) * square + (real)0.5 * at(p.lame, 2 * i) * dilation * dilation);
}
