// SPDX-License-Identifier: MIT
// Energy balance of a body from step to step, and the criterion of a runaway; shared by both devices (backends/cpu/native/energy.h,
// backends/gpu/energy_balance.cu).
//
//     kinetic  sum m v.v / 2          gravity  -sum m g.x          work  of pushes, grabs and contact since the start
//     budget   kinetic + elastic before the first step, + work, + what gravity has done since, sum m g.dx (g may change)
//
// What a change of parameters adds to the elastic energy is work, too.
//
// Elasticity and damping only take from the budget, so that kinetic <= budget up to the errors of the time step. A body runs away
// in the step in which
//   - kinetic > SLACK_OF_ENERGY max(budget, 0) + floor, or is NaN. Over all scenes and hard cases of the tests kinetic / budget is
//     at most 1.13, and energy that grows without bound soon exceeds any factor. The floor is the kinetic energy of a body all of
//     whose nodes move by 1e-3 of its size in a step: below it the budget may be rounding;
//   - the steps of two of its nodes differ along an axis by more than LONG times its size plus twice their difference at the
//     start. In the same cases it is at most 1.7 times, except where a body was thrown or spun. Without inertia this is the only
//     criterion.
// Explicit substeps: kinetic > SLACK_OF_SUBSTEPS (largest budget so far) + floor, since the kinetic energy of a mode of angular
// frequency w oscillates, up to 1 / (1 - (h w / 2)^2) of its energy, h the substep. What is not stable grows beyond any factor.
// With loads (effects/_loads.py) the work of a step is that of the forces of its last evaluation. Its error adds up where a load gives
// energy and takes it back in every beat, so that a part SLACK_OF_LOADS of all work, of either sign, counts as not known:
// of the last thousand steps or so, so that a long run is watched as a short one.
// Its size is the longer of the diagonals of its boxes at rest and at the start.
#pragma once
#include "host_device.cuh"

constexpr double SLACK_OF_ENERGY = 2, LONG = 4, SLOW = 1e-3;
constexpr double SLACK_OF_SUBSTEPS = 10, SLACK_OF_LOADS = 0.1, FADING = 0.999;

enum OnRunaway { FREEZE = 0, GO_ON = 1, UNWATCHED = 2 };
enum BalancePhase { WELL = 0, AWAY = 1, FROZEN = 2 };  // AWAY: ran away in the last step, and goes on

struct Sums {  // over nodes
    double kinetic, gravity, fallen, work;  // fallen: work of gravity
    double low[3], high[3];  // range of their steps [m]
};

HOST_DEVICE Sums no_sums() { return {0, 0, 0, 0, {1e300, 1e300, 1e300}, {-1e300, -1e300, -1e300}}; }

struct Balance {      // of a body, after its last step [J]
    double start;     // kinetic + elastic before the first step
    double mass;      // [kg]
    double diagonal;  // at rest [m]
    double floor;     // of kinetic
    double limit;     // of stride [m]
    double slack;     // of explicit substeps: kinetic may be this times `largest`; 0: an implicit scheme
    double largest;   // budget so far, with slack
    double driven;    // 1: the scene has loads, 0: none
    double gross;     // sum of |work| of the steps, with loads, fading by FADING a step
    double kinetic, elastic, gravity, work, budget;
    double fallen;    // work of gravity
    double stride;    // largest difference of two nodes' steps along an axis [m]
    int phase;
    int found;        // 1: found to run away in the last step; the figures are then of the state at its end
};

HOST_DEVICE double square(double a) { return a * a; }
HOST_DEVICE bool is_finite(double a) { return a - a == 0; }

template <class T>
HOST_DEVICE void add_node(Sums& s, double mass, const T* x, const T* v, const double* step, const T* gravity) {
    const double g[3] = {mass * gravity[0], mass * gravity[1], mass * gravity[2]};
    s.kinetic += 0.5 * mass * ((double)v[0] * v[0] + (double)v[1] * v[1] + (double)v[2] * v[2]);
    s.gravity -= g[0] * x[0] + g[1] * x[1] + g[2] * x[2];
    s.fallen += g[0] * step[0] + g[1] * step[1] + g[2] * step[2];
    for (int c = 0; c < 3; ++c) {
        s.low[c] = step[c] < s.low[c] ? step[c] : s.low[c];
        s.high[c] = step[c] > s.high[c] ? step[c] : s.high[c];
    }
}

// Work of a constant force and of a spring along the straight path from `from`: exact.
template <class T>
HOST_DEVICE double work_on(const T* force, double spring, const T* anchor, const T* from, const double* step) {
    double work = 0;
    for (int c = 0; c < 3; ++c) work += (force[c] + spring * ((double)anchor[c] - from[c] - 0.5 * step[c])) * step[c];
    return work;
}

HOST_DEVICE double stride_of(const Sums& s) {
    double most = 0;
    for (int c = 0; c < 3; ++c) most = s.high[c] - s.low[c] > most ? s.high[c] - s.low[c] : most;
    return most;
}

// Begins the balance; `elastic` and `diagonal` are set already. s: sums before the first step, with dt v for steps; size: diagonal
// at the start [m].
HOST_DEVICE void start_balance(Balance& b, const Sums& s, double size, double dt, bool inertia) {
    if (b.phase == FROZEN) return;
    const double longest = size > b.diagonal ? size : b.diagonal;
    b.kinetic = inertia ? s.kinetic : 0;
    b.gravity = s.gravity;
    b.work = b.fallen = b.largest = b.gross = 0;
    b.start = b.budget = b.kinetic + b.elastic;
    b.floor = 0.5 * b.mass * square(SLOW * longest / dt);
    b.limit = LONG * longest + 2 * stride_of(s);
    b.phase = WELL;
}

// Adds what a change of parameters adds to the elastic energy of a state; nothing if the law defines no energy there. Where the state
// has more elastic energy than the budget, by errors of the time step, the budget falls in the same proportion as the energy: else what
// is taken away could leave less than nothing, and the body, in which there is still some, would seem to run away. elastic: before [J]
HOST_DEVICE void add_work(Balance& b, double change, double elastic) {
    if (!is_finite(change)) return;
    const double budget = b.start + b.work + b.fallen;
    if (change < 0 && elastic > budget) change *= budget > 0 ? budget / elastic : 0;
    b.work += change;
}

// Updates the balance after a step. True if the body is to be frozen now.
HOST_DEVICE bool update_balance(Balance& b, const Sums& s, int on_runaway, bool inertia) {
    b.kinetic = inertia ? s.kinetic : 0;
    b.gravity = s.gravity;
    b.stride = stride_of(s);
    b.found = 0;
    const double given = is_finite(s.work) ? s.work : 0, work = b.work + given, fallen = b.fallen + s.fallen;
    b.budget = b.start + b.work + b.fallen;
    if (b.phase == FROZEN) return false;
    b.budget = b.start + work + fallen;
    double allowed = SLACK_OF_ENERGY * (b.budget > 0 ? b.budget : 0);
    if (b.slack > 0) {
        b.largest = b.budget > b.largest ? b.budget : b.largest;
        allowed = b.slack * b.largest;
    }
    const double gross = FADING * b.gross + b.driven * (given < 0 ? -given : given);
    const double most = allowed + SLACK_OF_LOADS * gross + b.floor;
    const bool known = b.budget == b.budget;  // NaN: the law defines no energy of the state at the start
    const bool away = !is_finite(s.kinetic) || !is_finite(s.gravity) || (known && b.kinetic > most) || b.stride > b.limit;
    b.found = away && on_runaway != UNWATCHED;
    b.phase = !b.found ? WELL : on_runaway == FREEZE ? FROZEN : AWAY;
    if (b.phase == FROZEN) return true;  // it goes back to where it was
    b.work = work;
    b.fallen = fallen;
    b.gross = gross;
    return false;
}
