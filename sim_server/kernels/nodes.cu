// SPDX-License-Identifier: MIT
// What every step does node by node, whatever its effects.
#define WIDE
#include "polar.cuh"

struct Start {
    int n;             // nodes
    const real* mass;  // (n,) [kg]
    real* diagonal;    // (n,) out: what goes onto the diagonal of A [kg]
    real* b;           // (n, 3) out: right-hand side, world frame [N s]
    real* mean;        // (n, 3, 3) out: sum of the elements' rotations
};

// Lumped mass and nothing else; the effects then add to all three.
KERNEL(start, Start) {
    put(p.diagonal, i, at(p.mass, i));
    store3(p.b, i, vec3{});
    store9(p.mean, i, mat3{});
}

struct Turn {
    int n;               // nodes
    const real* free;    // (n,) 1, or 0 at fixed nodes
    const real* warped;  // (n,) 1, or 0 where the rotation stays the identity
    const real* mean;    // (n, 3, 3) sum of the elements' rotations
    const real* b;       // (n, 3) world frame [N s]
    const real* dv;      // (n, 3) solution of the last step, world frame [m/s]
    real* rotation;      // (n, 3, 3) out: rotation of the node from rest to now
    real* b_material;    // (n, 3) out: R^T b, 0 at fixed nodes
    real* y;             // (n, 3) out: R^T dv, 0 at fixed nodes: where the solve starts
};

// Rotation of a node: the one nearest to the mean of its elements' (Courtecuisse et al. 2010, section 6).
KERNEL(turn, Turn) {
    mat3 R = nearest_rotation(load9(p.mean, i));
    number w = at(p.warped, i), keep = at(p.free, i);
    for (int k = 0; k < 9; ++k) R.m[k] = k % 4 == 0 ? w * R.m[k] + (1 - w) : w * R.m[k];
    mat3 Rt = transposed(R);
    store9(p.rotation, i, R);
    store3(p.b_material, i, keep * mul(Rt, load3(p.b, i)));
    store3(p.y, i, keep * mul(Rt, load3(p.dv, i)));
}

struct Advance {
    int n;                 // nodes
    const real* rotation;  // (n, 3, 3)
    const real* y;         // (n, 3) solution in the material frame [m/s]
    real h;                // [s]
    real* dv;              // (n, 3) out: R y [m/s]
    real* v;               // (n, 3) in, out [m/s]
    real* x;               // (n, 3) in, out [m]
};

// v += dv, x += h v (eq. 2).
KERNEL(advance, Advance) {
    vec3 dv = mul(load9(p.rotation, i), load3(p.y, i));
    vec3 v = load3(p.v, i) + dv;
    store3(p.dv, i, dv);
    store3(p.v, i, v);
    store3(p.x, i, load3(p.x, i) + constant(p.h) * v);
}
