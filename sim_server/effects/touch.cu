// SPDX-License-Identifier: MIT
// Pushes and grabs of remote clients (touch.py).
#include "mat3.cuh"

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
    real* force;             // (nodes, 3) out: what pushes, and grabs at their limit, exert in this step [N]
    real* spring;            // (nodes,) out: k of the grabs below their limit [N/m]
    real* anchor;            // (nodes, 3) out: where the spring pulls to [m]
};

// A grab is a spring: implicit below its limit, a constant force above. Which of the two is decided by its force at the end of the
// step, estimated with the node's own block of A as inertia; by the force at the start a stiff spring would throw the node from one
// side of its target to the other without end.
MAILED_KERNEL(apply, Apply) {
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
        if (now + p.dt / 2 >= p.start[k] + p.duration[k]) continue;  // a whole number of steps, in spite of rounding
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
        } else {
            b = b + h * pull;
            diagonal += h * dx_dv * spring;
            springs += spring;
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
