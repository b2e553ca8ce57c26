// SPDX-License-Identifier: MIT
// Nodal kernels of central differences (mechanics/central_difference.py).
#define WIDE
#include "mat3.cuh"

struct Remember {
    int n;          // nodes
    const real* x;  // (n, 3) [m]
    const real* v;  // (n, 3) [m/s]
    real* before;   // (n, 3) out: x when the step begins [m]
    real* start_v;  // (n, 3) out: v then [m/s]
};

KERNEL(remember, Remember) {
    store3(p.before, i, load3(p.x, i));
    store3(p.start_v, i, load3(p.v, i));
}

struct Begin {
    int n;                           // nodes
    const real* mass;                // (n,) [kg]
    const real* inertial_increment;  // (n, 3) of held nodes: less their acceleration; else 0 [m/s2]
    own<real> diagonal;              // (n, 1) out: mass, for grabs [kg]
    own<real> b;                     // (n, 3) out: force, world frame [N]
    own<local> block;                // (n, 6) out: 0
};

// Before the effects add their forces.
KERNEL(begin, Begin) {
    row_put<1>(p.diagonal, i, 0, at(p.mass, i));
    store3(p.b, i, at(p.mass, i) * load3(p.inertial_increment, i));
    for (int k = 0; k < 6; ++k) row_put<6>(p.block, i, k, local_number{});
}

struct Keep {
    int n;               // nodes
    const real* x;       // (n, 3) [m]
    const real* b;       // (n, 3) force there [N]
    real* kept_x;        // (n, 3) out [m]
    real* kept_force;    // (n, 3) out [N]
};

KERNEL(keep, Keep) {
    store3(p.kept_x, i, load3(p.x, i));
    store3(p.kept_force, i, load3(p.b, i));
}

struct Displace {
    int n;               // nodes
    const real* kept_x;  // (n, 3) [m]
    const real* mode;    // (n, 3) u, 0 at fixed nodes [m]
    real* x;             // (n, 3) out [m]
};

// To where the forces of an iteration are evaluated.
KERNEL(displace, Displace) { store3(p.x, i, load3(p.kept_x, i) + load3(p.mode, i)); }

// Velocity with which a node moves: of a fixed one, that of its holder.
INLINE vec3 motion(const real* free, const real* predictor, vec3 v, index i) { return select(at(free, i) == 0, load3(predictor, i), v); }

struct Open {
    int n;                  // nodes
    const real* substep;    // (1,) [s]
    const real* free;       // (n,) 1, or 0 at fixed nodes
    const real* predictor;  // (n, 3) velocity of holders at their nodes, else 0 [m/s]
    const real* before;     // (n, 3) x when the step begins [m]
    const real* start_v;    // (n, 3) v then [m/s]
    real* x;                // (n, 3) out: half a substep later [m]
    real* v;                // (n, 3) out [m/s]
};

// Begins a step, or begins it again.
KERNEL(open, Open) {
    vec3 v = load3(p.start_v, i);
    store3(p.v, i, v);
    store3(p.x, i, load3(p.before, i) + ((real)0.5 * at(p.substep, 0 * i)) * motion(p.free, p.predictor, v, i));
}

struct Shift {
    int n;                  // nodes
    const real* shift;      // (1,) [s]
    const real* free;       // (n,)
    const real* predictor;  // (n, 3) [m/s]
    const real* v;          // (n, 3) [m/s]
    real* x;                // (n, 3) in, out [m]
};

// To another half substep.
KERNEL(shift, Shift) {
    store3(p.x, i, load3(p.x, i) + at(p.shift, 0 * i) * motion(p.free, p.predictor, load3(p.v, i), i));
}

struct Kick {
    int n;                  // nodes
    const real* substep;    // (1,) [s]
    const real* mass;       // (n,) [kg]
    const real* alpha;      // (n,) Rayleigh damping of the mass [1/s]
    const real* free;       // (n,)
    const real* predictor;  // (n, 3) [m/s]
    own<real> b;            // (n, 3) force at x, but for the damping of the mass [N]
    real* v;                // (n, 3) in, out: half a substep before x, and after it [m/s]
    real* x;                // (n, 3) in, out: a substep later [m]
};

KERNEL(kick, Kick) {
    number h = at(p.substep, 0 * i), c = (real)0.5 * h * at(p.alpha, i);
    vec3 v = load3(p.v, i), later = (1 / (1 + c)) * ((1 - c) * v + (h / at(p.mass, i)) * load3(p.b, i));
    v = select(at(p.free, i) == 0, v, later);
    store3(p.v, i, v);
    store3(p.x, i, load3(p.x, i) + h * motion(p.free, p.predictor, v, i));
}

struct Close {
    int n;                  // nodes
    const real* substep;    // (1,) [s]
    const real* free;       // (n,)
    const real* predictor;  // (n, 3) [m/s]
    const int* body;        // (n,) of the node
    const int* failed;      // (bodies,) 1: the step gave no state
    const real* before;     // (n, 3) x when the step began [m]
    real* v;                // (n, 3) in, out [m/s]
    real* x;                // (n, 3) in: half a substep after the end of the step; out: at its end [m]
};

// Ends the step. A body whose step gave no state goes back to where it began, and rests there.
KERNEL(close, Close) {
    vec3 v = load3(p.v, i), zero = {}, x = load3(p.x, i) - ((real)0.5 * at(p.substep, 0 * i)) * motion(p.free, p.predictor, v, i);
    auto failed = as_number(at(p.failed, at(p.body, i))) != 0;
    store3(p.v, i, select(failed, zero, v));
    store3(p.x, i, select(failed, load3(p.before, i), x));
}
