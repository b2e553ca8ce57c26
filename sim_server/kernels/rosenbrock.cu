// SPDX-License-Identifier: MIT
// Nodal kernels of the second-order Rosenbrock-W step (formulas and symbols: mechanics/rosenbrock.py).
#define WIDE
#include "prepare_stage.cuh"
#include "step_form.h"

constexpr real GAMMA = ROS2_GAMMA;
constexpr real TWO = 2, THREE = 3;  // in the type of the numbers that they multiply

struct Start {
    int n;                           // nodes
    const real* mass;                // (n,) [kg]
    const real* inertial_increment;  // (n, 3) [m/s]
    own<real> diagonal;              // (n, 1) out: what goes onto the diagonal of A [kg]
    own<real> b;                     // (n, 3) out: right-hand side, world frame [N s]
    own<local> mean;                 // (n, 10) out: sum of q q^T
    own<local> known;                // (n, 6) nodes' own blocks of the last step that had A [kg]
    own<local> block;                // (n, 6) out: the same
};

// Begins the forces of a stage. Touch and rest learn from older blocks how stiff a node is.
KERNEL(start, Start) {
    for (int k = 0; k < 6; ++k) row_put<6>(p.block, i, k, row_at<6>(p.known, i, k));
    row_put<1>(p.diagonal, i, 0, at(p.mass, i));
    store3(p.b, i, at(p.mass, i) * load3(p.inertial_increment, i));
    for (int k = 0; k < 10; ++k) row_put<10>(p.mean, i, k, local_number{});
}

struct Remember {
    int n;              // nodes
    own<local> block;   // (n, 6) [kg]
    own<local> known;   // (n, 6) out
};

KERNEL(remember, Remember) {
    for (int k = 0; k < 6; ++k) row_put<6>(p.known, i, k, row_at<6>(p.block, i, k));
}

struct RotateForce {
    int n;                  // nodes
    const real* free;       // (n,) 1, or 0 at fixed nodes
    const local* rotation;  // (n, 3, 3) frame of the node at the first stage
    own<real> b;            // (n, 3) world frame [N s]
    const real* dv;         // (n, 3) start of the solve, world frame [m/s]
    real* b_material;       // (n, 3) out: R^T b, 0 at fixed nodes
    real* y;                // (n, 3) out: start of the solve, material frame
};

// The right-hand side of the second stage, in the frames of the first: its matrix is that of the first.
KERNEL(rotate_force, RotateForce) {
    mat3 Rt = transposed(as<number>(load9(p.rotation, i)));
    auto fixed = at(p.free, i) == 0;
    vec3 zero = {}, b = select(fixed, zero, mul(Rt, load3(p.b, i))), y = select(fixed, zero, mul(Rt, load3(p.dv, i)));
    store3(p.b_material, i, b);
    store3(p.y, i, y);
}

struct Prepare {
    int n;                     // nodes
    const real* share;         // (n,) theta [-]
    const real* weight;        // (n,) theta (1 + g h alpha) [-]
    const real* v;             // (n, 3) [m/s]
    real* predictor;           // (n, 3) out [m/s]
    real* damping_velocity;    // (n, 3) out [m/s]
    real* inertial_increment;  // (n, 3) out [m/s]
    real* dv;                  // (n, 3) out: start of the solve [m/s]
};

KERNEL(prepare, Prepare) {
    vec3 v = load3(p.v, i);
    prepare_stage(p, i, v, vec3{}, v);
}

struct Second {
    int n;                     // nodes
    const local* rotation;     // (n, 3, 3)
    const real* y;             // (n, 3) solution of the first stage, material frame [m/s]
    const real* share;         // (n,)
    const real* weight;        // (n,)
    real h;                    // time step [s]
    real* v;                   // (n, 3) in, out [m/s]
    real* x;                   // (n, 3) in, out [m]
    real* start_v;             // (n, 3) out: v at the start of the step [m/s]
    real* start_x;             // (n, 3) out: x at the start of the step [m]
    real* first;               // (n, 3) out: u_1 [m/s]
    real* predictor;           // (n, 3) out [m/s]
    real* damping_velocity;    // (n, 3) out [m/s]
    real* inertial_increment;  // (n, 3) out [m/s]
    real* dv;                  // (n, 3) out: start of the solve [m/s]
};

// u_1 from the solution of the first stage; state and right-hand side of the second.
KERNEL(second, Second) {
    vec3 x = load3(p.x, i), v = load3(p.v, i);
    vec3 u = mul(as<number>(load9(p.rotation, i)), load3(p.y, i)) - at(p.share, i) * v;
    vec3 moved = v + (1 / GAMMA) * u, start = (1 / GAMMA - 2) * u - v;
    store3(p.start_x, i, x);
    store3(p.start_v, i, v);
    store3(p.first, i, u);
    store3(p.x, i, x + p.h * (v + u));
    store3(p.v, i, moved);
    prepare_stage(p, i, moved, -TWO * u, start);
}

struct Finish {
    int n;                     // nodes
    const int* body;           // (n,) of the node
    const int* moving;         // (bodies,) 0: the body rests
    const local* rotation;     // (n, 3, 3)
    const real* y;             // (n, 3) solution of the second stage, material frame [m/s]
    const real* share;         // (n,)
    const real* weight;        // (n,)
    const real* start_v;       // (n, 3) [m/s]
    const real* start_x;       // (n, 3) [m]
    const real* first;         // (n, 3) u_1 [m/s]
    real h;                    // time step [s]
    real* v;                   // (n, 3) out [m/s]
    real* x;                   // (n, 3) out [m]
    real* before;              // (n, 3) in, out: x at the start of the step [m]
    real* earlier;             // (n, 3) out: the same of the step before [m]
    real* estimate;            // (n,) out: error of the step [m]
    real* predictor;           // (n, 3) out: of the next step, as the next three [m/s]
    real* damping_velocity;
    real* inertial_increment;
    real* dv;
};

// The state at the end of the step; a body at rest stays where it is.
KERNEL(finish, Finish) {
    vec3 x = load3(p.start_x, i), v = load3(p.start_v, i), u = load3(p.first, i), zero = {};
    vec3 start = (1 / GAMMA - 2) * u - v;
    vec3 w = mul(as<number>(load9(p.rotation, i)), load3(p.y, i)) - at(p.share, i) * start;
    vec3 k1 = v + u, k2 = start + w, off = (p.h / 2) * (k1 + k2);
    auto still = as_number(at(p.moving, at(p.body, i))) == 0;
    vec3 ended = select(still, zero, v + (1 / (2 * GAMMA)) * (THREE * u + w));
    store3(p.x, i, select(still, x, x + (p.h / 2) * (THREE * k1 + k2)));
    store3(p.v, i, ended);
    store3(p.earlier, i, load3(p.before, i));
    store3(p.before, i, x);
    put(p.estimate, i, still ? number{} : sqrt(dot(off, off)));
    prepare_stage(p, i, ended, zero, ended);
}

struct Restore {
    int n;                     // nodes
    const real* share;         // (n,)
    const real* weight;        // (n,)
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

// Back to the start of the step, for another attempt.
KERNEL(restore, Restore) {
    vec3 v = load3(p.start_v, i);
    store3(p.x, i, load3(p.start_x, i));
    store3(p.before, i, load3(p.earlier, i));
    store3(p.v, i, v);
    prepare_stage(p, i, v, vec3{}, v);
}

struct Euler {
    int n;                     // nodes
    const local* rotation;     // (n, 3, 3)
    const real* y;             // (n, 3) solution, material frame [m/s]
    const real* share;         // (n,)
    const real* weight;        // (n,)
    real h;                    // time step [s]
    real* v;                   // (n, 3) in, out [m/s]
    real* x;                   // (n, 3) in, out [m]
    real* before;              // (n, 3) in, out: x when the step before began [m]
    real* predictor;           // (n, 3) out: of the next step, as the next three [m/s]
    real* damping_velocity;
    real* inertial_increment;
    real* dv;
};

// v += dv, x += h v. A body whose forces are NaN goes back and rests there, as in nodes.cu.
KERNEL(euler, Euler) {
    vec3 y = load3(p.y, i), x = load3(p.x, i), before = load3(p.before, i), zero = {};
    auto refused = y.x != y.x;
    vec3 v = select(refused, zero, load3(p.v, i) + mul(as<number>(load9(p.rotation, i)), y));
    store3(p.x, i, select(refused, before, x + p.h * v));
    store3(p.v, i, v);
    store3(p.before, i, select(refused, before, x));
    prepare_stage(p, i, v, zero, v);
}
