// SPDX-License-Identifier: MIT
// What a step does node by node in other schemes than backward Euler with one linearization (integrator.py has the formulas and
// the coefficients).
#define WIDE
#include "mat3.cuh"

struct Inertia {
    int n;                // nodes
    const real* mass;     // (n,) [kg]
    const real* carried;  // (n, 3) velocity gained without a force at the end of the step [m/s]
    own<real> diagonal;   // (n, 1) out: what goes onto the diagonal of A [kg]
    own<real> b;          // (n, 3) out: right-hand side, world frame [N s]
    own<local> block;     // (n, 6) out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;      // (n, 10) out: upper triangle of the sum of q q^T, q the elements' rotations
};

// As `start` of nodes.cu, with what the steps before have left: b = m carried.
KERNEL(inertia, Inertia) {
    row_put<1>(p.diagonal, i, 0, at(p.mass, i));
    store3(p.b, i, at(p.mass, i) * load3(p.carried, i));
    for (int k = 0; k < 6; ++k) row_put<6>(p.block, i, k, local_number{});
    for (int k = 0; k < 10; ++k) row_put<10>(p.mean, i, k, local_number{});
}

// (reach ahead + beta v) / (reach + beta)
INLINE vec3 drift_of(vec3 ahead, vec3 v, real reach, number beta) {
    return (1 / (reach + beta)) * (reach * ahead + beta * v);
}

struct Prepare {
    int n;             // nodes
    const real* v;     // (n, 3) [m/s]
    const real* beta;  // (n,) Rayleigh damping of the stiffness [s]
    real reach;        // dx / dv [s]
    real of_v;         // part of v in ahead
    real* ahead;       // (n, 3) out [m/s]
    real* drift;       // (n, 3) out [m/s]
    real* carried;     // (n, 3) out: 0 [m/s]
};

// Before the first step.
KERNEL(prepare, Prepare) {
    vec3 v = load3(p.v, i), ahead = p.of_v * v;
    store3(p.ahead, i, ahead);
    store3(p.drift, i, drift_of(ahead, v, p.reach, at(p.beta, i)));
    store3(p.carried, i, vec3{});
}

struct Begin {
    int n;              // nodes
    const real* v;      // (n, 3) [m/s]
    const real* b;      // (n, 3) impulse times the force, world frame [N s]
    const real* mass;   // (n,) [kg]
    const real* free;   // (n,) 1, or 0 at fixed nodes
    const real* beta;   // (n,) [s]
    real reach;         // [s]
    real impulse;       // [s]
    real of_v;          // part of v in ahead
    real of_a;          // part of the acceleration in ahead [s]
    real carries_a;     // ... and in carried [s]
    real* ahead;        // (n, 3) out [m/s]
    real* drift;        // (n, 3) out [m/s]
    real* carried;      // (n, 3) out [m/s]
};

// The first step of a scheme that looks back, from the acceleration at the beginning.
KERNEL(begin, Begin) {
    vec3 v = load3(p.v, i), a = (at(p.free, i) / (p.impulse * at(p.mass, i))) * load3(p.b, i);
    vec3 ahead = p.of_v * v + p.of_a * a;
    store3(p.ahead, i, ahead);
    store3(p.drift, i, drift_of(ahead, v, p.reach, at(p.beta, i)));
    store3(p.carried, i, p.carries_a * a);
}

struct Advance {
    int n;                  // nodes
    const local* rotation;  // (n, 3, 3)
    const real* y;          // (n, 3) solution in the material frame [m/s]
    const real* beta;       // (n,) [s]
    real reach;             // [s]
    real keeps_v;           // 1, or 0 without inertia
    real of_v;              // parts in the next ahead: of v,
    real of_way;            // of (motion in this step) / reach,
    real of_gain;           // and of dv - carried
    real carries_gain;      // part of dv - carried in the next carried
    real carries_dv;        // ... and of dv
    real* carried;          // (n, 3) in, out [m/s]
    real* ahead;            // (n, 3) in, out [m/s]
    real* drift;            // (n, 3) out [m/s]
    real* dv;               // (n, 3) out: R y [m/s]
    real* v;                // (n, 3) in, out [m/s]
    real* x;                // (n, 3) in, out [m]
    real* before;           // (n, 3) in, out: x when the step before began [m]
};

// v += dv, x += reach (ahead + dv), and what the next step is to know of this one. A body whose forces are no numbers goes back
// and rests there, as in nodes.cu.
KERNEL(advance, Advance) {
    vec3 y = load3(p.y, i), dv = mul(as<number>(load9(p.rotation, i)), y), x = load3(p.x, i), before = load3(p.before, i), zero = {};
    vec3 way = load3(p.ahead, i) + dv, gain = dv - load3(p.carried, i);
    vec3 v = p.keeps_v * load3(p.v, i) + dv;
    vec3 ahead = p.of_v * v + p.of_way * way + p.of_gain * gain;
    auto refused = y.x != y.x;
    store3(p.dv, i, select(refused, zero, dv));
    store3(p.v, i, select(refused, zero, v));
    store3(p.x, i, select(refused, before, x + p.reach * way));
    store3(p.before, i, select(refused, before, x));
    store3(p.ahead, i, select(refused, zero, ahead));
    store3(p.drift, i, select(refused, zero, drift_of(ahead, v, p.reach, at(p.beta, i))));
    store3(p.carried, i, select(refused, zero, p.carries_gain * gain + p.carries_dv * dv));
}
