// SPDX-License-Identifier: MIT
// Shared by the texts of corotational tetrahedra (formulas: effects/corotational.py).
#pragma once
#include "polar.cuh"
#include "coalesced_io.cuh"

INLINE local_mat3 rest_gradients(const local* gradients, int n, index i) {
    local_mat3 g;
    for (int k = 0; k < 9; ++k) g.m[k] = at_items(gradients + k * n, i);
    return g;
}

// Gradient of a nodal field over the element: its differences in the field's precision.
template <class T> INLINE mat<T> gradient(const real* field, const index (&tet)[4], const mat<T>& g) {
    vec3 u = load3(field, tet[0]);
    return outer3(as<T>(load3(field, tet[1]) - u), as<T>(load3(field, tet[2]) - u), as<T>(load3(field, tet[3]) - u), g);
}

// Stress of h (strain) + k (strain rate), times V, in the frame of the element; S = R^T F, T = R^T G.
INLINE local_mat3 hooke(const local_mat3& S, const local_mat3& T, local h, local_number k, local_number lambda, local_number mu) {
    local_number pressure = lambda * (h * (trace(S) - 3) + k * trace(T));
    local_number xx = 2 * mu * (h * (S.m[0] - 1) + k * T.m[0]) + pressure;
    local_number yy = 2 * mu * (h * (S.m[4] - 1) + k * T.m[4]) + pressure;
    local_number zz = 2 * mu * (h * (S.m[8] - 1) + k * T.m[8]) + pressure;
    local_number xy = mu * (h * (S.m[1] + S.m[3]) + k * (T.m[1] + T.m[3]));
    local_number xz = mu * (h * (S.m[2] + S.m[6]) + k * (T.m[2] + T.m[6]));
    local_number yz = mu * (h * (S.m[5] + S.m[7]) + k * (T.m[5] + T.m[7]));
    return symmetric(xx, xy, xz, yy, yz, zz);
}

// Nodal impulses of the corners, -P grad N_a.
INLINE void put_impulses(local* nodal_impulse, index i, int n, const local_mat3& P, const local_mat3& g) {
    local_vec3 f1 = mul(P, row(g, 0)), f2 = mul(P, row(g, 1)), f3 = mul(P, row(g, 2)), f0 = f1 + f2 + f3;
    const local_number row[12] = {f0.x, f0.y, f0.z, -f1.x, -f1.y, -f1.z, -f2.x, -f2.y, -f2.z, -f3.x, -f3.y, -f3.z};
    put_row(nodal_impulse, i, n, row);
}

// Scaled gradients w R grad N_a and the ratio lambda / mu, of every corner.
INLINE void put_scaled_gradients(local* scaled_gradients, index i, int n, const local_mat3& R, const local_mat3& g, local_number w,
                                 local_number ratio) {
    local_vec3 g1 = w * mul(R, row(g, 0)), g2 = w * mul(R, row(g, 1)), g3 = w * mul(R, row(g, 2));
    local_vec3 g0 = -(g1 + g2 + g3);
    const local_number row[16] = {g0.x, g0.y, g0.z, ratio, g1.x, g1.y, g1.z, ratio,
                                  g2.x, g2.y, g2.z, ratio, g3.x, g3.y, g3.z, ratio};
    put_row(scaled_gradients, i, n, row);
}
