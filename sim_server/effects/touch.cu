// SPDX-License-Identifier: MIT
// Pushes and grabs of remote clients (touch.py).
#include "mat3.cuh"
#include "reaction.h"

struct Apply {
    int n;                   // nodes touched
    const int* node;         // (n,) ascending
    const int* first;        // (n + 1,) into the entries
    const int* entry;        // (first[n],) interaction of each entry
    const real* offset;      // (first[n], 3) of the node from the grabbed point [m]
    const real* share;       // (interactions,) 1 / nodes of the interaction
    double* start;           // (interactions,) in, out: negative until its first step [s]
    const double* duration;  // (interactions,) [s]
    const real* push;        // (interactions, 3) force of a push [N]
    const real* target;      // (interactions, 3) of a grab [m]
    const real* stiffness;   // (interactions,) of a grab; 0: a push [N/m]
    const real* limit;       // (interactions,) largest force of a grab [N]
    const double* clock;     // (1,) [s]
    const real* x;           // (nodes, 3) [m]
    const real* predictor;   // (nodes, 3) world.predictor: the step moves x by dx_dv (predictor + dv) [m/s]
    const real* free;        // (nodes,) 1, or 0 at fixed nodes
    own<local> block;        // (nodes, 6) what elements have put into the node's own block of A, world frame [kg]
    double dt;               // time step [s]
    const real* coefficients;  // (2,) h, world.force_coefficient, and dx_dv, world.dx_dv: both dt in backward Euler [s]
    own<real> diagonal;      // (nodes, 1) in, out: += h dx_dv k [kg]
    own<real> b;             // (nodes, 3) in, out: += h f - h dx_dv k predictor [N s]
    const int* only;         // (1,) the body whose nodes alone are touched; -1: all
    int interactions;
    const int* whose;        // (interactions, 2) id of each, body that it acts on
    const int* held_start;   // (interactions + 1,) into `held`
    const int* held;         // (first[n], 2) entries of each interaction, and their nodes
    real* pull;              // (first[n], 4) out, by entry of a grab that acts: k [N/m] below its limit, -1 at it, where the force [N]
                             // follows; 0: it does not act
    real* force;             // (nodes, 3) out: what pushes, and grabs at their limit, exert in this step [N]
    real* spring;            // (nodes,) out: k of the grabs below their limit [N/m]
    real* anchor;            // (nodes, 3) out: where the spring pulls to [m]
};

// A grab is a spring: implicit below its limit, a constant force above. Which of the two is decided by its force at the end of the
// step, estimated with the node's own block of A as inertia; by the force at the start a stiff spring would throw the node from one
// side of its target to the other without end.
MAILED_KERNEL(apply, Apply) {
    if (p.only[0] >= 0 && p.whose[2 * p.entry[p.first[i]] + 1] != p.only[0]) return;
    int node = p.node[i];
    vec3 x = load3(p.x, node), predictor = load3(p.predictor, node), b = load3(p.b, node);
    real diagonal = row_at<1>(p.diagonal, node, 0);
    vec3 force = {}, anchored = {};
    const real h = p.coefficients[0], dx_dv = p.coefficients[1];
    real springs = 0;
    real inertia = diagonal + (row_at<6>(p.block, node, 0) + row_at<6>(p.block, node, 3) + row_at<6>(p.block, node, 5)) / 3;
    for (int e = p.first[i]; e < p.first[i + 1]; ++e) {
        int k = p.entry[e];
        double now = p.clock[0];
        if (p.start[k] < 0) p.start[k] = now;  // all nodes write the same
        if (now + p.dt / 2 >= p.start[k] + p.duration[k]) {
            p.pull[4 * e] = 0;
            continue;
        }  // a whole number of steps, in spite of rounding
        real share = p.share[k];
        if (p.stiffness[k] == 0) {
            b = b + (h * share) * load3(p.push, k);
            force = force + share * load3(p.push, k);
            continue;
        }
        real spring = share * p.stiffness[k], limit = share * p.limit[k];
        vec3 goal = load3(p.target, k) + load3(p.offset, e);
        vec3 pull = spring * (goal - x - dx_dv * predictor);
        real size = sqrt(dot(pull, pull));
        if (size > limit * (1 + h * dx_dv * spring / inertia)) {
            b = b + (h * limit / size) * pull;
            force = force + (limit / size) * pull;
            p.pull[4 * e] = -1;
            const vec3 most = (limit / size) * pull;
            p.pull[4 * e + 1] = most.x;
            p.pull[4 * e + 2] = most.y;
            p.pull[4 * e + 3] = most.z;
        } else {
            b = b + h * pull;
            diagonal += h * dx_dv * spring;
            springs += spring;
            p.pull[4 * e] = spring;
            anchored = anchored + spring * (goal - x);
        }
    }
    if (p.free[node] == 0) return;
    store3(p.b, node, b);
    row_put<1>(p.diagonal, node, 0, diagonal);
    store3(p.force, node, force);
    put(p.spring, node, springs);
    store3(p.anchor, node, springs > 0 ? x + (1 / springs) * anchored : x);
}

#ifndef ITEMS_ONLY

// Sums of a grab over its nodes: number of them, force on the node, where it holds, torque about the origin.
constexpr int HELD_SUMS = 10;

// Adds what entry `k` of interaction `g` has from the state after a step.
INLINE void add_held(const Apply& p, int g, int k, double* sum) {
    const int e = p.held[2 * k], node = p.held[2 * k + 1];
    const real* pull = p.pull + 4 * e;
    if (pull[0] == 0) return;
    double x[3], f[3];
    for (int m = 0; m < 3; ++m) {
        x[m] = p.x[3 * node + m];
        f[m] = pull[0] < 0 ? (double)pull[1 + m] : (double)pull[0] * ((double)p.target[3 * g + m] + p.offset[3 * e + m] - x[m]);
        sum[1 + m] += f[m];
        sum[4 + m] += x[m] - p.offset[3 * e + m];
    }
    sum[0] += 1;
    sum[7] += x[1] * f[2] - x[2] * f[1];
    sum[8] += x[2] * f[0] - x[0] * f[2];
    sum[9] += x[0] * f[1] - x[1] * f[0];
}

// What a body exerts on the hand that holds it: the contrary of what the spring does. False: the grab does not act.
INLINE bool held_reaction(const Apply& p, int g, long long step, const double* sum, Reaction& out) {
    if (sum[0] == 0) return false;
    double at[3], f[3], t[3];
    for (int m = 0; m < 3; ++m) {
        at[m] = sum[4 + m] / sum[0];
        f[m] = -sum[1 + m];
        t[m] = -sum[7 + m];
    }
    out.step = step;
    out.number = p.whose[2 * g];
    out.body = p.whose[2 * g + 1];
    out.kind = ON_GRAB;
    for (int m = 0; m < 3; ++m) {
        const int a = (m + 1) % 3, b = (m + 2) % 3;
        out.force[m] = f[m];
        out.torque[m] = t[m] - (at[a] * f[b] - at[b] * f[a]);
        out.point[m] = at[m];
    }
    return true;
}

#ifdef __CUDACC_RTC__
constexpr int HOLDING_THREADS = 128;  // GRAB_THREADS of backends/gpu/engine.py

// Writes the reactions on grabs after a step to the host, those of slot `step - 1`, with their number: of an interaction that is no grab, or
// does not act, `number` is -1. out: (capacity, most); counts: (capacity,). A thread block sums over the nodes of a grab in a fixed order.
extern "C" __global__ void __launch_bounds__(HOLDING_THREADS) react(const Apply* mail, const long long* steps, Reaction* out, long long* counts, int most, int capacity) {
    __shared__ double part[HOLDING_THREADS][HELD_SUMS];
    const Apply p = *mail;
    const long long step = steps[0], slot = (step - 1) % capacity;
    const int count = p.n ? p.interactions : 0, me = threadIdx.x;
    if (blockIdx.x == 0 && me == 0) counts[slot] = count;
    for (int g = blockIdx.x; g < count && g < most; g += gridDim.x) {
        double* sum = part[me];
        for (int m = 0; m < HELD_SUMS; ++m) sum[m] = 0;
        for (int k = p.held_start[g] + me; k < p.held_start[g + 1]; k += HOLDING_THREADS) add_held(p, g, k, sum);
        for (int by = HOLDING_THREADS / 2; by; by /= 2) {
            __syncthreads();
            for (int m = 0; m < HELD_SUMS && me < by; ++m) sum[m] += part[me + by][m];
        }
        if (me == 0 && !held_reaction(p, g, step, sum, out[slot * most + g])) out[slot * most + g].number = -1;
        __syncthreads();
    }
}
#else
// Writes the reactions on grabs after `step` steps to `out`, which has room for all interactions; returns their number. out null: that room.
extern "C" int react(const void* params, long long step, Reaction* out) {
    const Apply p = *static_cast<const Apply*>(params);
    int count = 0;
    if (!out) return p.n ? p.interactions : 0;
    for (int g = 0; g < p.interactions && p.n; ++g) {
        double sum[HELD_SUMS] = {};
        for (int k = p.held_start[g]; k < p.held_start[g + 1]; ++k) add_held(p, g, k, sum);
        count += held_reaction(p, g, step, sum, out[count]);
    }
    return count;
}
#endif

#endif
