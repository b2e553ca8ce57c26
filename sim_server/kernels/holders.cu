// SPDX-License-Identifier: MIT
// Groups of nodes that move as rigid bodies, and the forces that it takes (sim_server/effects/_holders.py).
#include "kernel.h"
#include "shapes.cuh"

// Where a held node is at a pose of its holder: start + u + (R - 1) arm, u the displacement of the holder's centre. At the pose at
// which it began that is `start` to the bit.
INLINE void held_point(const double* pose, const double* center, const double* arm, const double* start, double* x) {
    double turned[3];
    world_vector(pose, arm, turned);
    for (int k = 0; k < 3; ++k) x[k] = start[k] + ((pose[k] - center[k]) + (turned[k] - arm[k]));
}

// Rotation from pose a to pose b: axis times angle, the shorter way.
INLINE void rotation_between(const double* a, const double* b, double* out) {
    const double p[4] = {a[3], -a[4], -a[5], -a[6]}, *q = b + 3;
    double w = q[0] * p[0] - q[1] * p[1] - q[2] * p[2] - q[3] * p[3];
    double v[3] = {q[0] * p[1] + q[1] * p[0] + q[2] * p[3] - q[3] * p[2], q[0] * p[2] + q[2] * p[0] + q[3] * p[1] - q[1] * p[3],
                   q[0] * p[3] + q[3] * p[0] + q[1] * p[2] - q[2] * p[1]};
    const double size = sqrt(dot3(v, v)), angle = 2 * atan2(size, magnitude(w)), sign = w < 0 ? -1 : 1;
    for (int k = 0; k < 3; ++k) out[k] = size > 0 ? sign * angle / size * v[k] : 0;
}

struct Hold {
    int n;                     // held nodes
    const int* node;           // (n,) of the scene
    const int* holder;         // (n,)
    const int* witness;        // (n,) a node of the same body that nothing holds
    const real* free;          // (nodes,) 0 at witnesses of frozen bodies
    const double* start;       // (n, 3) where the node began [m]
    const double* arm;         // (n, 3) from the holder's centre to there [m]
    const double* center;      // (holders, 3) where the holder began [m]
    const double* begin;       // (holders, 7) pose at the start of the step
    const double* end;         // (holders, 7) and at its end
    const double* velocity;    // (n, 3) at the start of the step [m/s]
    const real* beta;          // (nodes,) damping of the stiffness [s]; unused in a plain scheme
    double h;                  // time step [s]
    double dx_dv;              // [s]
    double force_coefficient;  // [s]
    int plain;                 // 1: backward Euler with one linearization
    int search;                // 1: several linearizations
    int euler;                 // 1: a step of backward Euler in a scene of another scheme
    double* next;              // (n, 3) out: where the node is at the end of the step [m]
    double* later;             // (n, 3) out: its velocity then [m/s]
    real* x;                   // (nodes, 3) in; with a search out
    real* v;                   // (nodes, 3) out; in a step of backward Euler in: at the start of the step
    real* predictor;           // (nodes, 3) out
    real* damping_velocity;    // (nodes, 3) out
    real* inertial_increment;  // (nodes, 3) out, but in a plain scheme
};

// Before the elements: what they take for a held node's velocity has the whole change of the step in it, so that they subtract the
// columns of A times that change from b. A search has the node at the end of the step instead; a second call changes nothing.
KERNEL(hold, Hold) {
    const int node = p.node[i], holder = p.holder[i];
    if (p.free[p.witness[i]] == 0) return;
    const double *begin = p.begin + 7 * holder, *end = p.end + 7 * holder, *arm = p.arm + 3 * i;
    double next[3], turn[3], turned[3];
    held_point(end, p.center + 3 * holder, arm, p.start + 3 * i, next);
    rotation_between(begin, end, turn);
    world_vector(end, arm, turned);
    for (int k = 0; k < 3; ++k) {
        const int at = 3 * node + k, a = (k + 1) % 3, b = (k + 2) % 3;
        const double step = next[k] - p.x[at], beta = p.plain ? 0 : p.beta[node];
        const double rigid = ((end[k] - begin[k]) + turn[a] * turned[b] - turn[b] * turned[a]) / p.h;
        const double v = p.plain || p.euler ? step / p.h : rigid, before = p.euler ? p.v[at] : p.velocity[3 * i + k];
        p.next[3 * i + k] = next[k];
        p.later[3 * i + k] = v;
        p.v[at] = v;
        if (p.plain) continue;  // all velocities are v
        p.predictor[at] = p.search ? 0 : step / p.dx_dv;
        p.damping_velocity[at] = ((p.search ? 0 : step) + beta * v) / (p.dx_dv + beta);
        p.inertial_increment[at] = -p.force_coefficient / p.h * (v - before);
        if (p.search) p.x[at] = next[k];
    }
}

struct HoldWithin {
    int n;                 // held nodes
    const int* node;       // (n,) of the scene
    const int* holder;     // (n,)
    const int* witness;    // (n,)
    const real* free;      // (nodes,)
    const double* start;   // (n, 3) [m]
    const double* arm;     // (n, 3) [m]
    const double* center;  // (holders, 3) [m]
    const double* begin;   // (holders, 7)
    const double* next;    // (n, 3) [m]
    double share;          // part of the step after which the forces balance [-]
    real* x;               // (nodes, 3) out
};

// After `hold` with a search, where the forces balance within the step (mechanics/generalized_alpha.py).
KERNEL(hold_within, HoldWithin) {
    const int node = p.node[i];
    if (p.free[p.witness[i]] == 0) return;
    double x[3];
    held_point(p.begin + 7 * p.holder[i], p.center + 3 * p.holder[i], p.arm + 3 * i, p.start + 3 * i, x);
    for (int k = 0; k < 3; ++k) p.x[3 * node + k] = x[k] + p.share * (p.next[3 * i + k] - x[k]);
}

struct Settle {
    int n;                     // held nodes
    const int* node;           // (n,) of the scene
    const int* holder;         // (n,)
    const int* witness;        // (n,)
    const real* free;          // (nodes,)
    const double* start;       // (n, 3) [m]
    const double* arm;         // (n, 3) [m]
    const double* center;      // (holders, 3) [m]
    const double* begin;       // (holders, 7)
    const double* next;        // (n, 3) [m]
    const double* later;       // (n, 3) [m/s]
    const int* first;          // (n,) into blocks: those that couple the node to free ones
    const int* last;           // (n,) where they end
    const int* columns;        // (blocks,) free nodes
    const local* blocks;       // (blocks, 3, 3) of A, world frame [kg]
    const local* rotation;     // (nodes, 3, 3)
    const real* b;             // (nodes, 3) [N s]
    const real* mass;          // (nodes,) in A [kg]
    double dx_dv;              // [s]
    double force_coefficient;  // [s]
    int plain;
    int search;
    int inertia;               // 0: the solution is the velocity
    const double* clock;       // (1,) t at the start of the step [s]
    double* settled;           // (n,) in, out: t of the step whose force `load` has; negative at first [s]
    real* x;                   // (nodes, 3) with a search out: where the node was at the start of the step
    real* y;                   // (nodes, 3) in: solution, material frame; without inertia out at held nodes [m/s]
    real* predictor;           // (nodes, 3) with a search or without inertia out
    double* velocity;          // (n, 3) in, out: at the end of the step [m/s]
    double* force;             // (n, 3) in, out: on the node [N]
    real* load;                // (nodes, 3) in, out: forces that the energy balance counts [N]
};

// Has the energy balance count the force at held node i, in place of that of an earlier attempt at the same step.
template <class P> INLINE void tell_force(const P& p, int i, int k, bool again, double force) {
    p.load[3 * p.node[i] + k] += force - (again ? p.force[3 * i + k] : 0);
    p.force[3 * i + k] = force;
}

// After the solve, before the state advances: the force at a held node is what its equation lacks.
KERNEL(settle, Settle) {
    const int node = p.node[i];
    const double again = p.y[3 * node];  // NaN: the body goes back
    double sum[3] = {0, 0, 0}, x[3], step[3];
    const bool moves = p.free[p.witness[i]] != 0 && again == again;
    for (int t = p.first[i]; moves && !p.search && t < p.last[i]; ++t) {
        const local *A = p.blocks + 9 * (long long)t, *R = p.rotation + 9 * (long long)p.columns[t];
        const real* y = p.y + 3 * p.columns[t];
        double dv[3];
        for (int k = 0; k < 3; ++k) dv[k] = (double)R[3 * k] * y[0] + (double)R[3 * k + 1] * y[1] + (double)R[3 * k + 2] * y[2];
        for (int k = 0; k < 3; ++k) sum[k] += A[3 * k] * dv[0] + A[3 * k + 1] * dv[1] + A[3 * k + 2] * dv[2];
    }
    const bool told = p.settled[i] == p.clock[0];
    p.settled[i] = p.clock[0];
    if (moves && p.search) held_point(p.begin + 7 * p.holder[i], p.center + 3 * p.holder[i], p.arm + 3 * i, p.start + 3 * i, x);
    for (int k = 0; k < 3; ++k) {
        const int at = 3 * node + k;
        double &velocity = p.velocity[3 * i + k], impulse = sum[k] - p.b[at];
        if (p.plain) impulse += p.mass[node] * (p.later[3 * i + k] - velocity);
        const double force = moves ? impulse / p.force_coefficient : 0;
        velocity = moves ? p.later[3 * i + k] : 0;
        tell_force(p, i, k, told, force);
        if (!moves || (p.inertia && !p.search)) continue;
        if (p.search) p.x[at] = x[k];
        step[k] = (p.next[3 * i + k] - p.x[at]) / p.dx_dv;
        p.predictor[at] = p.inertia ? step[k] : 0;
    }
    const local* R = p.rotation + 9 * (long long)node;
    for (int k = 0; k < 3 && moves && !p.inertia; ++k) p.y[3 * node + k] = R[k] * step[0] + R[3 + k] * step[1] + R[6 + k] * step[2];
}

// --- steps by two stages (mechanics/rosenbrock.py) ------------------------------------------------------------------------------------

struct HoldFirst {
    int n;                     // held nodes
    const int* node;           // (n,) of the scene
    const int* holder;         // (n,)
    const int* witness;        // (n,)
    const real* free;          // (nodes,)
    const int* body;           // (nodes,)
    const double* start;       // (n, 3) [m]
    const double* arm;         // (n, 3) [m]
    const double* center;      // (holders, 3) [m]
    const double* begin;       // (holders, 7)
    const double* end;         // (holders, 7)
    const real* beta;          // (nodes,) [s]
    const real* share;         // (nodes,) theta [-]
    double h;                  // [s]
    const real* x;             // (nodes, 3) at the start of the step [m]
    const real* v;             // (nodes, 3) likewise [m/s]
    double* next;              // (n, 3) out: at the end of the step [m]
    double* later;             // (n, 3) out: likewise [m/s]
    double* velocity;          // (n, 3) out: at the start of the step [m/s]
    double* shift;             // (n, 3) out: y_c of the first stage; that of the second is less than 0 by as much [m/s]
    real* damping_velocity;    // (nodes, 3) out
    real* inertial_increment;  // (nodes, 3) out: 0
    int* moves;                // (bodies,) out: 1 where a holder moves in the step
};

// Before the forces of the first stage. In the stages a held node has the straight motion from x to `next`, with the mean velocity
// V and acceleration a of the step: its parts of k_1 are V and a, of k_2 -V and -a. So y_c = theta (V + beta a), times the columns
// of A, goes to the right-hand side, as part of the velocity that the elements take.
KERNEL(hold_first, HoldFirst) {
    const int node = p.node[i], holder = p.holder[i];
    if (p.free[p.witness[i]] == 0) return;
    const double *begin = p.begin + 7 * holder, *end = p.end + 7 * holder, *arm = p.arm + 3 * i, share = p.share[node];
    double next[3], turn[3], turned[3];
    held_point(end, p.center + 3 * holder, arm, p.start + 3 * i, next);
    rotation_between(begin, end, turn);
    world_vector(end, arm, turned);
    for (int k = 0; k < 3; ++k) {
        const int at = 3 * node + k, a = (k + 1) % 3, b = (k + 2) % 3;
        const double later = ((end[k] - begin[k]) + turn[a] * turned[b] - turn[b] * turned[a]) / p.h, before = p.v[at];
        const double V = (next[k] - p.x[at]) / p.h, shift = share * (V + p.beta[node] * (later - before) / p.h);
        p.next[3 * i + k] = next[k];
        p.later[3 * i + k] = later;
        p.velocity[3 * i + k] = before;
        p.shift[3 * i + k] = shift;
        p.damping_velocity[at] = (1 - share) * before + shift;
        p.inertial_increment[at] = 0;
        if (V != 0 || later != 0 || before != 0) p.moves[p.body[node]] = 1;
    }
}

struct HoldSecond {
    int n;                     // held nodes
    const int* node;           // (n,) of the scene
    const int* witness;        // (n,)
    const real* free;          // (nodes,)
    const real* share;         // (nodes,)
    const double* next;        // (n, 3) [m]
    const double* later;       // (n, 3) [m/s]
    const double* shift;       // (n, 3) [m/s]
    const real* b;             // (nodes, 3) of the first stage [N s]
    double* sum;               // (n, 3) out: b at held nodes [N s]
    real* x;                   // (nodes, 3) out
    real* v;                   // (nodes, 3) out
    real* damping_velocity;    // (nodes, 3) out
    real* inertial_increment;  // (nodes, 3) out: 0
};

// Before the forces of the second stage, which is at the end of the step.
KERNEL(hold_second, HoldSecond) {
    const int node = p.node[i];
    if (p.free[p.witness[i]] == 0) return;
    for (int k = 0; k < 3; ++k) {
        const int at = 3 * node + k;
        p.sum[3 * i + k] = p.b[at];
        p.x[at] = p.next[3 * i + k];
        p.v[at] = p.later[3 * i + k];
        p.damping_velocity[at] = (1 - p.share[node]) * p.later[3 * i + k] - p.shift[3 * i + k];
        p.inertial_increment[at] = 0;
    }
}

struct SettleStages {
    int n;                     // held nodes
    const int* node;           // (n,) of the scene
    const int* witness;        // (n,)
    const real* free;          // (nodes,)
    const int* body;           // (nodes,)
    const int* moving;         // (bodies,) 0: the body rests, and has no second stage
    const real* mass;          // (nodes,) [kg]
    const real* share;         // (nodes,)
    const real* weight;        // (nodes,) w [-]
    double h;                  // [s]
    double force_coefficient;  // [s]
    const double* clock;       // (1,) [s]
    double* settled;           // (n,) in, out [s]
    const double* next;        // (n, 3) [m]
    const double* later;       // (n, 3) [m/s]
    const double* velocity;    // (n, 3) at the start of the step [m/s]
    const double* sum;         // (n, 3) b of the first stage [N s]
    const real* b;             // (nodes, 3) of the last stage [N s]
    real* x;                   // (nodes, 3) out
    real* v;                   // (nodes, 3) out
    real* predictor;           // (nodes, 3) out: of the next step, as the next three [m/s]
    real* damping_velocity;
    real* inertial_increment;
    real* dv;
    real* estimate;            // (nodes,) out: 0
    double* force;             // (n, 3) in, out [N]
    real* load;                // (nodes, 3) in, out [N]
};

// After an attempt. The force is what the mean of those of both stages lacks.
KERNEL(settle_stages, SettleStages) {
    const int node = p.node[i];
    const bool moves = p.free[p.witness[i]] != 0, told = p.settled[i] == p.clock[0], still = p.moving[p.body[node]] == 0;
    const double share = p.share[node];
    p.settled[i] = p.clock[0];
    for (int k = 0; k < 3; ++k) {
        const int at = 3 * node + k;
        const double later = p.later[3 * i + k], impulse = still ? (double)p.b[at] : (p.sum[3 * i + k] + p.b[at]) / 2;
        const double force = p.mass[node] * (later - p.velocity[3 * i + k]) / p.h - impulse / p.force_coefficient;
        tell_force(p, i, k, told, moves ? force : 0);
        if (!moves) continue;
        p.x[at] = p.next[3 * i + k];
        p.v[at] = later;
        p.predictor[at] = p.damping_velocity[at] = (1 - share) * later;
        p.inertial_increment[at] = p.weight[node] * later;
        p.dv[at] = share * later;
        p.estimate[node] = 0;
    }
}

struct Total {
    int n;                // holders
    const int* first;     // (n,) into held nodes
    const int* last;      // (n,) where they end
    const int* place;     // (n,) row of `reaction`
    const double* end;    // (n, 7)
    const double* next;   // (held nodes, 3) [m]
    const double* force;  // (held nodes, 3) on nodes [N]
    double* reaction;     // (rows, 6) out: force [N] and torque about the centre [N m] on the holder
};

KERNEL(total, Total) {
    double sum[6] = {0, 0, 0, 0, 0, 0};
    for (int t = p.first[i]; t < p.last[i]; ++t) {
        const double* f = p.force + 3 * t;
        double arm[3];
        for (int k = 0; k < 3; ++k) arm[k] = p.next[3 * t + k] - p.end[7 * i + k];
        for (int k = 0; k < 3; ++k) {
            const int a = (k + 1) % 3, b = (k + 2) % 3;
            sum[k] -= f[k];
            sum[3 + k] -= arm[a] * f[b] - arm[b] * f[a];
        }
    }
    for (int k = 0; k < 6; ++k) p.reaction[6 * p.place[i] + k] = sum[k];
}
