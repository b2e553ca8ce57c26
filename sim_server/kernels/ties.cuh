// SPDX-License-Identifier: MIT
// Attachments and springs, shared by both devices: rows among those of contact whose force on their first side is linear in a step,
//     f = f_0 - K s,   s the displacement in the step of the first point relative to the second.
// A spring of stiffness k, length l and rest length l_0 pulls by k (l - l_0) along its direction at the start of the step; K = k along
// it and k (1 - l_0 / l), if above 0, across. An attachment has K = k I and carries its force from step to step (augmented Lagrangian:
// Nocedal and Wright, Numerical Optimization, section 17.3), f = f of the last step - k (gap at the end of this step): at rest there is
// no gap. k is kappa / h^2 over the sum of w_a^2 / A_aa of its corners, from the first step.
#pragma once
#include "contact_law.cuh"

struct Ties {                     // attachments and springs: rows after all others, by the body of their first corner
    int first, count, tables;     // row of the first one; of all; tables of the scene that they are from
    const int* start;             // (bodies + 1,)
    const int* body;              // (count, 2) of the first corner and of the others; -1: there are none
    const int* obstacle;          // (count,) -1: none
    const int *table, *order;     // (count,) table of each; ties by table
    const double* point;          // (count, 3) in the obstacle's frame [m]
    const double *kappa, *rest, *breaking;  // (count,) of attachments, 0: a spring; rest length [m]; force that breaks it [N]
    double* stiffness;            // (count,) [N/m]; 0: set in the first step
    double* force;                // (count, 3) on the first corner, at the end of the last step [N]
    double *start_force, *slope;  // (count, 3), (count, 6) f_0 and K of this step
    int* bound;                   // (nodes,) 1 + the other body that a node is attached to, 0: none; they do not touch there
    int* broken;                  // (count,) steps completed when it broke; 0: it has not
    double* reaction;             // (bodies, columns, 6) those of tables from column_first on
    int columns, column_first;
};

// True for a tie between two bodies.
HOST_DEVICE bool joins_bodies(const Ties& t, int i) { return t.body[2 * i + 1] >= 0 && t.body[2 * i + 1] != t.body[2 * i]; }

// What the row of a tie has as the number of what is touched: its other body, or its own; -1: it is broken.
HOST_DEVICE int other_of_tie(const Ties& t, int i) { return t.broken[i] ? -1 : t.body[2 * i + 1] >= 0 ? t.body[2 * i + 1] : t.body[2 * i]; }

// True if corner a binds its node to another body, which the two then do not touch there. node: of the corner
HOST_DEVICE bool binds(const Ties& t, int i, int node) { return node >= 0 && t.kappa[i] > 0 && t.body[2 * i + 1] >= 0; }
HOST_DEVICE int bound_to(const Ties& t, int i, int corner) { return t.body[2 * i + (corner == 0)]; }

// e = first point minus second, at the start of the step; that of an obstacle is where it comes to. corner, weight: (rows, CORNERS)
template <class Real>
HOST_DEVICE void gap_of_tie(const Ties& t, const ObstacleTable& obstacles, const int* corner, const double* weight, const Real* x, int i, double* e) {
    const int at = CORNERS * (t.first + i);
    e[0] = e[1] = e[2] = 0;
    for (int a = 0; a < CORNERS; ++a)
        for (int k = 0; k < 3 && corner[at + a] >= 0; ++k) e[k] += weight[at + a] * (double)x[3 * (long long)corner[at + a] + k];
    if (t.obstacle[i] < 0) return;
    double end[3];
    world_point(obstacles.end + 7 * t.obstacle[i], t.point + 3 * i, end);
    for (int k = 0; k < 3; ++k) e[k] -= end[k];
}

// h^2 times the sum of w_a^2 / A_aa of the corners that may move [1 / (N/m)]; scale: h^2. block_of(node): its own block of A
template <class Real, class Of>
HOST_DEVICE double compliance_of_tie(const Ties& t, const int* corner, const double* weight, const Real* free, double scale, int i, Of block_of) {
    const int at = CORNERS * (t.first + i);
    double sum = 0;
    for (int a = 0; a < CORNERS; ++a) {
        const int node = corner[at + a];
        if (node < 0 || free[node] == 0) continue;
        const Real* A = block_of(node);
        const double w = weight[at + a];
        sum += 3 * w * w / ((double)A[0] + (double)A[4] + (double)A[8]);
    }
    return sum > 0 ? scale * sum : 1;
}

HOST_DEVICE void attach(const Ties& t, int i, const double* e) {
    const double k = t.stiffness[i], K[6] = {k, 0, 0, k, 0, k};
    for (int m = 0; m < 6; ++m) t.slope[6 * i + m] = K[m];
    for (int m = 0; m < 3; ++m) t.start_force[3 * i + m] = t.force[3 * i + m] - k * e[m];
}
HOST_DEVICE void stretch(const Ties& t, int i, const double* e) {
    const double length = sqrt(dot3(e, e)), k = t.stiffness[i], pull = k * (length - t.rest[i]);
    const double across = pull > 0 ? pull / length : 0;
    int n = 0;
    for (int l = 0; l < 3; ++l) {
        const double along = length > 0 ? e[l] / length : 0;
        t.start_force[3 * i + l] = -pull * along;
        for (int m = l; m < 3; ++m)
            t.slope[6 * i + n++] = (l == m ? across : 0) + (k - across) * along * (length > 0 ? e[m] / length : 0);
    }
}

// Sets f_0 and K of the step. e: of gap_of_tie
HOST_DEVICE void set_tie(const Ties& t, int i, const double* e) {
    if (t.kappa[i] > 0) attach(t, i, e);
    else stretch(t, i, e);
}

// Force on the first side at displacement s; it counts as closed, and acts whatever its size.
HOST_DEVICE ContactForce force_of_tie(const Ties& t, int i, const double* s) {
    const double *f = t.start_force + 3 * i, *K = t.slope + 6 * i;
    const double back[3] = {K[0] * s[0] + K[1] * s[1] + K[2] * s[2], K[1] * s[0] + K[3] * s[1] + K[4] * s[2], K[2] * s[0] + K[4] * s[1] + K[5] * s[2]};
    return {0, {f[0] - back[0], f[1] - back[1], f[2] - back[2]}, 1, true};
}
HOST_DEVICE void stiffness_of_tie(const Ties& t, int i, double scale, double* k) {
    for (int m = 0; m < 6; ++m) k[m] = scale * t.slope[6 * i + m];
}

// Keeps the force of the step; acts: the row was in the solve, whose bodies are well.
HOST_DEVICE void keep_tie(const Ties& t, int i, bool acts, const double* f, long long step) {
    for (int k = 0; k < 3; ++k) t.force[3 * i + k] = acts ? f[k] : 0;
    if (acts && sqrt(dot3(f, f)) > t.breaking[i]) t.broken[i] = (int)step;
}

// sum += force and torque that the first body exerts by a tie. arm: of its first point
HOST_DEVICE void add_reaction_of_tie(const double* f, const double* arm, double* sum) {
    for (int k = 0; k < 3; ++k) {
        const int a = (k + 1) % 3, b = (k + 2) % 3;
        sum[k] -= f[k];
        sum[3 + k] -= arm[a] * f[b] - arm[b] * f[a];
    }
}
