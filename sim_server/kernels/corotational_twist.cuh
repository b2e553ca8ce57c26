// SPDX-License-Identifier: MIT
// What the exact tangent of corotational elements adds to the usual one (formulas: effects/corotational.py).
#pragma once
#include "corotational.cuh"
#include "eigen3.cuh"

// sum e / (2 m) u u^T over the twists, from S = R^T F; e is clamped at 0. usual: mu / m, over: (p - 2 mu) / m, p the pressure, m any
// modulus.
INLINE local_mat3 twists(const local_mat3& S, local_number usual, local_number over) {
    const local half = 0.5;
    local_number h[6] = {S.m[4] + S.m[8], -half * (S.m[1] + S.m[3]), -half * (S.m[2] + S.m[6]),
                         S.m[0] + S.m[8], -half * (S.m[5] + S.m[7]), S.m[0] + S.m[4]};
    const local_number zero = local_number{}, one = zero + 1, least = zero + (local)1e-4;  // below, R is not unique
    local_vec3 u[3] = {{one, zero, zero}, {zero, one, zero}, {zero, zero, one}};
    eigen3(h, u);
    local_mat3 E = {};
    for (int k = 0; k < 3; ++k) {
        local_number e = larger(usual + over / larger(h[k == 0 ? 0 : k == 1 ? 3 : 5], least), zero);
        local_vec3 w = e * u[k];
        E.m[0] += w.x * u[k].x; E.m[1] += w.x * u[k].y; E.m[2] += w.x * u[k].z;
        E.m[4] += w.y * u[k].y; E.m[5] += w.y * u[k].z; E.m[8] += w.z * u[k].z;
    }
    return symmetric(E.m[0], E.m[1], E.m[2], E.m[4], E.m[5], E.m[8]);
}

// Adds to a stress what E adds to it, which is of the spin of T; k_m: stiffness coefficient times m V.
INLINE void add_spin_stress(local_mat3& P, const local_mat3& T, const local_mat3& E, local_number k_m) {
    local_vec3 c = k_m * mul(E, local_vec3{T.m[5] - T.m[7], T.m[6] - T.m[2], T.m[1] - T.m[3]});
    P.m[1] += c.z; P.m[2] -= c.y; P.m[3] -= c.z; P.m[5] += c.x; P.m[6] += c.y; P.m[7] -= c.x;
}
