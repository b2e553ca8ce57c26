// SPDX-License-Identifier: MIT
// A step by explicit substeps of central differences (method: mechanics/central_difference.py). The forces are the launches that
// other schemes assemble with, but for A. A step that ran away is made again with half the substep, RETRIES times at most.
#pragma once
#include <algorithm>

#include "energy.h"

static void take_mail(Launch& l, int64_t step);

static void run_nodal(const Loop& loop, int number) { run(loop.launch[number], loop.threads); }

// Runs what a step runs once before its substeps. New pushes, grabs or moves: the stable step is estimated at once.
static void begin_substeps(Loop& loop) {
    for (int i = 0; i < loop.before; ++i) {
        const Binding* last = loop.launch[i].binding;
        take_mail(loop.launch[i], loop.rings.step);
        if (loop.launch[i].binding != last) loop.substeps->state.since = ESTIMATE_EVERY;
    }
    for (int i = 0; i < loop.substeps->held; ++i) run(loop.launch[i], loop.threads);
}

static void evaluate_forces(const Loop& loop) {
    for (int i = loop.substeps->held; i < loop.before; ++i) run(loop.launch[i], loop.threads);
}

// Takes the frequency of a body from the forces at x + u, and makes the next u. k: number of the iteration (stable_step.cuh).
static void measure_frequency(const Loop& loop, int index, int k) {
    const CentralDifference& c = *loop.substeps;
    const Body& body = loop.body[index];
    ModeSums s = no_mode();
    for (int i = body.first; i < body.last; ++i)
        if (c.free[i] != 0) add_mode(s, c.mass[i], c.mode + 3 * i, c.kept_force + 3 * i, c.force + 3 * i);
    note_frequency(c.stable[index], s, k);
    for (int i = body.first; i < body.last; ++i) {
        double* u = c.mode + 3 * i;
        if (c.free[i] == 0) u[0] = u[1] = u[2] = 0;
        else next_mode(c.stable[index], s, k, i, c.mass[i], c.kept_force + 3 * i, c.force + 3 * i, u);
    }
}

static double least_stable_step(const Loop& loop) {
    double stable = 1e300;
    for (int i = 0; i < loop.bodies; ++i) stable = std::fmin(stable, stable_step_of(loop.substeps->stable[i]));
    return stable;
}

// Makes iterations k of the estimate of the stable step, from `first` to before `end`, at x with the forces there.
static void estimate_stable_step(const Loop& loop, int first, int end) {
    CentralDifference& c = *loop.substeps;
    run_nodal(loop, c.keep);
    for (int k = first; k < end; ++k) {
        run_nodal(loop, c.displace);
        evaluate_forces(loop);
        for (int i = 0; i < loop.bodies; ++i) measure_frequency(loop, i, k);
    }
    std::memcpy(loop.x, c.kept_x, sizeof(double) * 3 * loop.nodes);
    std::memcpy(c.force, c.kept_force, sizeof(double) * 3 * loop.nodes);
    c.state.since = 0;
}

// Evaluates the forces of a substep, and now and then the stable step. The rest of the step has shorter substeps if it has to.
static void evaluate_substep(const Loop& loop) {
    CentralDifference& c = *loop.substeps;
    evaluate_forces(loop);
    if (c.state.since < ESTIMATE_EVERY) return;
    estimate_stable_step(loop, FIRST_ITERATIONS, FIRST_ITERATIONS + 1);
    if (!shorten(c.state, least_stable_step(loop), c.substep, c.shift_time)) return;
    run_nodal(loop, c.shift);
    evaluate_forces(loop);
}

static void run_substeps(const Loop& loop) {
    CentralDifference& c = *loop.substeps;
    c.substep[0] = loop.rings.dt / c.state.substeps;
    run_nodal(loop, c.open);
    for (c.state.left = c.state.substeps; c.state.left > 0; --c.state.left, ++c.state.since) {
        evaluate_substep(loop);
        run_nodal(loop, c.kick);
    }
}

// Whether a body runs away in the step as it is now (kernels/energy_balance.cuh). Notes whether it has no state at all.
static bool runs_away(const Loop& loop, int index) {
    Balance balance = loop.energies->balance[index];
    const Sums s = sums_of(loop, loop.body[index], true);
    update_balance(balance, s, GO_ON, true);
    loop.substeps->failed[index] = !is_finite(s.kinetic) || !is_finite(s.gravity);
    return balance.found;
}

static void make_substeps(Loop& loop) {
    CentralDifference& c = *loop.substeps;
    const double begin = now();
    run_nodal(loop, c.remember);
    if (!c.state.substeps) {
        evaluate_forces(loop);
        estimate_stable_step(loop, 0, FIRST_ITERATIONS);
    }
    begin_step(c.state, loop.rings.dt, least_stable_step(loop));
    for (bool again = true; again;) {
        run_substeps(loop);
        again = false;
        for (int i = 0; i < loop.bodies; ++i) again = runs_away(loop, i) || again;
        again = again && try_again(c.state);
    }
    for (int i = 0; i < loop.bodies; ++i) {
        const Body& body = loop.body[i];
        c.result[i] = {0, now() - begin, 0, c.failed[i] ? NOT_FINITE : CONVERGED, NONE, 0, 0, 0};
        std::fill(loop.y + 3 * (int64_t)body.first, loop.y + 3 * (int64_t)body.last, c.failed[i] ? NAN : 0);  // tells holders
    }
    run_nodal(loop, c.close);
}

static void note_substeps(const CentralDifference& c, int body, Record& record) {
    record.substeps = c.state.substeps;
    record.stable_step = stable_step_of(c.stable[body]);
}
