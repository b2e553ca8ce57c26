// SPDX-License-Identifier: MIT
// Nodal updates of all schemes other than backward Euler with one linearization (formulas and coefficients: integrator.py).
#define WIDE
#include "mat3.cuh"

struct Inertia {
    int n;                           // nodes
    const real* mass;                // (n,) [kg]
    const real* inertial_increment;  // (n, 3) V - v: velocity gained in the step without a force [m/s]
    own<real> diagonal;              // (n, 1) out: what goes onto the diagonal of A [kg]
    own<real> b;                     // (n, 3) out: right-hand side, world frame [N s]
    own<local> block;                // (n, 6) out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;                 // (n, 10) out: upper triangle of the sum of q q^T, q the elements' rotations
};

// As `start` of nodes.cu, with b = m inertial_increment.
KERNEL(inertia, Inertia) {
    row_put<1>(p.diagonal, i, 0, at(p.mass, i));
    store3(p.b, i, at(p.mass, i) * load3(p.inertial_increment, i));
    for (int k = 0; k < 6; ++k) row_put<6>(p.block, i, k, local_number{});
    for (int k = 0; k < 10; ++k) row_put<10>(p.mean, i, k, local_number{});
}

// (dx_dv predictor + beta v) / (dx_dv + beta)
INLINE vec3 damping_velocity_of(vec3 predictor, vec3 v, real dx_dv, number beta) {
    return (1 / (dx_dv + beta)) * (dx_dv * predictor + beta * v);
}

struct Prepare {
    int n;                     // nodes
    const real* v;             // (n, 3) [m/s]
    const real* beta;          // (n,) Rayleigh damping of the stiffness [s]
    real dx_dv;                // dx / dv [s]
    real from_velocity;        // weight of v in the predictor
    real* predictor;           // (n, 3) out [m/s]
    real* damping_velocity;    // (n, 3) out [m/s]
    real* inertial_increment;  // (n, 3) out: 0 [m/s]
};

// Before the first step.
KERNEL(prepare, Prepare) {
    vec3 v = load3(p.v, i), predictor = p.from_velocity * v;
    store3(p.predictor, i, predictor);
    store3(p.damping_velocity, i, damping_velocity_of(predictor, v, p.dx_dv, at(p.beta, i)));
    store3(p.inertial_increment, i, vec3{});
}

struct Begin {
    int n;                           // nodes
    const real* v;                   // (n, 3) [m/s]
    const real* b;                   // (n, 3) force_coefficient times the force, world frame [N s]
    const real* mass;                // (n,) [kg]
    const real* free;                // (n,) 1, or 0 at fixed nodes
    const real* beta;                // (n,) [s]
    real dx_dv;                      // [s]
    real force_coefficient;          // [s]
    real from_velocity;              // weight of v in the predictor
    real from_acceleration;          // weight of the acceleration in the predictor [s]
    real inertia_from_acceleration;  // weight of the acceleration in the inertial increment [s]
    real* predictor;                 // (n, 3) out [m/s]
    real* damping_velocity;          // (n, 3) out [m/s]
    real* inertial_increment;        // (n, 3) out [m/s]
};

// Before the first step of a scheme with memory: from the acceleration at the beginning.
KERNEL(begin, Begin) {
    vec3 v = load3(p.v, i), a = (at(p.free, i) / (p.force_coefficient * at(p.mass, i))) * load3(p.b, i);
    vec3 predictor = p.from_velocity * v + p.from_acceleration * a;
    store3(p.predictor, i, predictor);
    store3(p.damping_velocity, i, damping_velocity_of(predictor, v, p.dx_dv, at(p.beta, i)));
    store3(p.inertial_increment, i, p.inertia_from_acceleration * a);
}

struct Advance {
    int n;                     // nodes
    const local* rotation;     // (n, 3, 3)
    const real* y;             // (n, 3) solution in the material frame [m/s]
    const real* beta;          // (n,) [s]
    real dx_dv;                // [s]
    real keeps_velocity;       // 1, or 0 without inertia
    real from_velocity;        // weight in the next predictor of v
    real from_step;            // weight in the next predictor of (x' - x) / dx_dv
    real from_force;           // weight in the next predictor of dv - inertial_increment
    real inertia_from_force;   // weight of dv - inertial_increment in the next inertial increment
    real inertia_from_dv;      // weight of dv in the next inertial increment
    real* inertial_increment;  // (n, 3) in, out [m/s]
    real* predictor;           // (n, 3) in, out [m/s]
    real* damping_velocity;    // (n, 3) out [m/s]
    real* dv;                  // (n, 3) out: R y [m/s]
    real* v;                   // (n, 3) in, out [m/s]
    real* x;                   // (n, 3) in, out [m]
    real* before;              // (n, 3) in, out: x when the step before began [m]
};

// v += dv, x += dx_dv (predictor + dv), and predictor, inertial increment and damping velocity of the next step. A body whose forces
// are NaN goes back and rests there, as in nodes.cu.
KERNEL(advance, Advance) {
    vec3 y = load3(p.y, i), dv = mul(as<number>(load9(p.rotation, i)), y), x = load3(p.x, i), before = load3(p.before, i), zero = {};
    vec3 step_velocity = load3(p.predictor, i) + dv, force_increment = dv - load3(p.inertial_increment, i);
    vec3 v = p.keeps_velocity * load3(p.v, i) + dv;
    vec3 predictor = p.from_velocity * v + p.from_step * step_velocity + p.from_force * force_increment;
    auto refused = y.x != y.x;
    store3(p.dv, i, select(refused, zero, dv));
    store3(p.v, i, select(refused, zero, v));
    store3(p.x, i, select(refused, before, x + p.dx_dv * step_velocity));
    store3(p.before, i, select(refused, before, x));
    store3(p.predictor, i, select(refused, zero, predictor));
    store3(p.damping_velocity, i, select(refused, zero, damping_velocity_of(predictor, v, p.dx_dv, at(p.beta, i))));
    store3(p.inertial_increment, i, select(refused, zero, p.inertia_from_force * force_increment + p.inertia_from_dv * dv));
}

struct AdvanceGeneralizedAlpha {
    int n;                     // nodes
    const local* rotation;     // (n, 3, 3)
    const real* y;             // (n, 3) solution in the material frame [m/s]
    const real* beta;          // (n,) [s]
    real dx_dv;                // [s]
    real whole;                // 1 / (1 - alpha_f): the step over its part up to the generalized mid point
    real from_velocity;        // weight in the next predictor of v
    real from_inertia;         // weight in the next predictor of the next inertial increment
    real inertia_from_force;   // weight of dv - inertial_increment in the next inertial increment
    real inertia_from_inertia; // weight of the inertial increment in the next one
    real* inertial_increment;  // (n, 3) in, out [m/s]
    real* predictor;           // (n, 3) in, out [m/s]
    real* damping_velocity;    // (n, 3) out [m/s]
    real* dv;                  // (n, 3) out: R y, up to the generalized mid point [m/s]
    real* v;                   // (n, 3) in, out [m/s]
    real* x;                   // (n, 3) in, out [m]
    real* before;              // (n, 3) in, out: x when the step before began [m]
};

// As `advance`, on from the generalized mid point to the end of the step (formulas: mechanics/generalized_alpha.py).
KERNEL(advance_generalized_alpha, AdvanceGeneralizedAlpha) {
    vec3 y = load3(p.y, i), dv = mul(as<number>(load9(p.rotation, i)), y), x = load3(p.x, i), before = load3(p.before, i), zero = {};
    vec3 step_velocity = load3(p.predictor, i) + dv, inertial = load3(p.inertial_increment, i), v = load3(p.v, i) + p.whole * dv;
    inertial = p.inertia_from_force * (dv - inertial) + p.inertia_from_inertia * inertial;
    vec3 predictor = p.from_velocity * v + p.from_inertia * inertial;
    auto refused = y.x != y.x;
    store3(p.dv, i, select(refused, zero, dv));
    store3(p.v, i, select(refused, zero, v));
    store3(p.x, i, select(refused, before, x + (p.whole * p.dx_dv) * step_velocity));
    store3(p.before, i, select(refused, before, x));
    store3(p.predictor, i, select(refused, zero, predictor));
    store3(p.damping_velocity, i, select(refused, zero, damping_velocity_of(predictor, v, p.dx_dv, at(p.beta, i))));
    store3(p.inertial_increment, i, select(refused, zero, inertial));
}

struct RestoreForEuler {
    int n;                     // nodes
    const real* start_v;       // (n, 3) [m/s]
    const real* start_x;       // (n, 3) [m]
    const real* earlier;       // (n, 3) [m]
    real* v;                   // (n, 3) out [m/s]
    real* x;                   // (n, 3) out [m]
    real* before;              // (n, 3) out: x when the step before began [m]
    real* predictor;           // (n, 3) out [m/s]
    real* damping_velocity;    // (n, 3) out [m/s]
    real* inertial_increment;  // (n, 3) out [m/s]
    real* dv;                  // (n, 3) out: start of the solve [m/s]
};

// Back to the start of the step, for a step of backward Euler of a body in a scene of another scheme (backends/euler_form.py).
KERNEL(restore_for_euler, RestoreForEuler) {
    vec3 v = load3(p.start_v, i), zero = {};
    store3(p.x, i, load3(p.start_x, i));
    store3(p.before, i, load3(p.earlier, i));
    store3(p.v, i, v);
    store3(p.predictor, i, v);
    store3(p.damping_velocity, i, v);
    store3(p.inertial_increment, i, zero);
    store3(p.dv, i, zero);
}

struct AdvanceEuler {
    int n;                     // nodes
    const local* rotation;     // (n, 3, 3)
    const real* y;             // (n, 3) solution in the material frame [m/s]
    const real* beta;          // (n,) [s]
    real h;                    // time step [s]
    real dx_dv;                // of the scheme, as the next six [s]
    real force_coefficient;    // [s]
    real from_velocity;        // weights of `advance`
    real from_step;
    real from_force;
    real inertia_from_force;
    real inertia_from_dv;
    real* inertial_increment;  // (n, 3) out: of the next step, as the next two [m/s]
    real* predictor;
    real* damping_velocity;
    real* dv;                  // (n, 3) out: R y [m/s]
    real* v;                   // (n, 3) in, out [m/s]
    real* x;                   // (n, 3) in, out [m]
    real* before;              // (n, 3) in, out: x when the step before began [m]
};

// v += dv, x += h v, and what the next step of the scheme begins from: as if it had made this one, with the acceleration dv / h.
KERNEL(advance_euler, AdvanceEuler) {
    vec3 y = load3(p.y, i), dv = mul(as<number>(load9(p.rotation, i)), y), x = load3(p.x, i), before = load3(p.before, i), zero = {};
    vec3 v = load3(p.v, i) + dv, force_increment = (p.force_coefficient / p.h) * dv;
    vec3 predictor = p.from_velocity * v + (p.from_step * p.h / p.dx_dv) * v + p.from_force * force_increment;
    auto refused = y.x != y.x;
    store3(p.dv, i, select(refused, zero, dv));
    store3(p.v, i, select(refused, zero, v));
    store3(p.x, i, select(refused, before, x + p.h * v));
    store3(p.before, i, select(refused, before, x));
    store3(p.predictor, i, select(refused, zero, predictor));
    store3(p.damping_velocity, i, select(refused, zero, damping_velocity_of(predictor, v, p.dx_dv, at(p.beta, i))));
    store3(p.inertial_increment, i, select(refused, zero, p.inertia_from_force * force_increment + p.inertia_from_dv * dv));
}
