// SPDX-License-Identifier: MIT
// Springs of nodes to the positions of a target shape (formulas: target.py).
#define WIDE
#include "mat3.cuh"

struct Tie {
    int n;                  // nodes
    const real* stiffness;  // (n,) k [N/m]
    const real* goal;       // (n, 3) [m]
    const real* x;          // (n, 3) [m]
    const real* predictor;  // (n, 3) displacement predictor over dx_dv [m/s]
    real h;                 // world.force_coefficient [s]
    real dx_dv;             // world.dx_dv [s]
    own<real> diagonal;     // (n, 1) in, out: += h dx_dv k [kg]
    own<real> b;            // (n, 3) in, out: -= h k (x + dx_dv predictor - goal) [N s]
};

KERNEL(tie, Tie) {
    number k = p.h * at(p.stiffness, i);
    vec3 away = load3(p.x, i) + p.dx_dv * load3(p.predictor, i) - load3(p.goal, i);
    store3(p.b, i, load3(p.b, i) - k * away);
    row_put<1>(p.diagonal, i, 0, row_at<1>(p.diagonal, i, 0) + p.dx_dv * k);
}

struct TargetEnergy {
    int n;                  // nodes
    const real* stiffness;  // (n,) [N/m]
    const real* goal;       // (n, 3) [m]
    const real* x;          // (n, 3) [m]
    real* energy;           // (n,) out: k / 2 |x - goal|^2 [J]
};

KERNEL(energy, TargetEnergy) {
    vec3 away = load3(p.x, i) - load3(p.goal, i);
    put(p.energy, i, (real)0.5 * at(p.stiffness, i) * dot(away, away));
}
