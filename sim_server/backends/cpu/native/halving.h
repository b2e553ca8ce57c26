// SPDX-License-Identifier: MIT
// The step of a body that runs away (kernels/energy_balance.cuh) is made again, from where it began, by short steps of backward Euler:
// two of half the time step, then four, up to 2^levels, until it does not run away (input: backends/halving.py). Other bodies have made
// theirs. To see it before it is too late the elastic energy counts, too: kinetic + elastic may not exceed the bound of the kinetic
// energy, and must be a number, in every step in which two nodes move further apart than SLOW times the body's size.
//
// The next steps of the body are made of as many short ones, since what made it run away is mostly still there: SHORTEST_PATIENCE at
// first, each time twice as many; after CALM steps without a runaway it begins anew. Where short steps do not help the step ends as the
// scheme made it, and the body is frozen if its kinetic energy says so; if not, the elastic energy does not count for as long.
#pragma once
#include <algorithm>
#include <cstring>

#include "contact_rows.h"
#include "energy.h"
#include "rosenbrock.h"

constexpr int SHORTEST_PATIENCE = 8, LONGEST_PATIENCE = 1 << 20, CALM = 10000;

// Keeps the state that the step begins with.
static void remember_start(const Loop& loop) {
    const Halving& h = *loop.halving;
    std::memcpy(h.start_x, loop.x, sizeof(double) * 3 * (int64_t)loop.nodes);
    std::memcpy(h.start_v, loop.v, sizeof(double) * 3 * (int64_t)loop.nodes);
}

static void copy_nodes(const Body& body, double* to, const double* from, int width = 3) {
    const int64_t at = width * (int64_t)body.first;
    std::memcpy(to + at, from + at, sizeof(double) * width * (body.last - body.first));
}

// Elastic energy of a body as it is now [J]; NaN beyond what its law defines.
static double elastic_of(const Loop& loop, int index) {
    double sum = 0;
    for (int k = 0; k < loop.energies->elastics; ++k) {
        const Elastic& e = loop.energies->elastic[k];
        const int first = e.parts[index], last = e.parts[index + 1];
        if (first < last) e.launch.kernel(e.launch.binding->params, first, last);
        for (int j = first; j < last; ++j) sum += e.energy[j];
    }
    return sum;
}

// Whether the body runs away in the step as it is now. elastic: its elastic energy counts, too. whole: it is one step, not the sum of
// short ones, which may be as long as it is.
static bool ran_away(const Loop& loop, int index, bool elastic, bool whole) {
    Balance b = loop.energies->balance[index];
    if (!whole) b.limit = INFINITY;
    update_balance(b, sums_of(loop, loop.body[index], true), GO_ON, loop.energies->inertia);
    if (b.found || !elastic || b.budget != b.budget) return b.found;
    const double slow = loop.rings.dt * std::sqrt(2 * b.floor / b.mass);  // SLOW times the size
    if (b.stride < slow) return false;
    const double most = SLACK_OF_ENERGY * std::max(b.budget, 0.0) + SLACK_OF_LOADS * b.gross + b.floor;
    return !(b.kinetic + elastic_of(loop, index) <= most);
}

// Adds the solve of a short step: the last status other than converged, the largest residual, all iterations.
static void add_solve(SolveResult& sum, const SolveResult& r) {
    sum.iterations += r.iterations;
    sum.seconds += r.seconds;
    sum.fallbacks += r.fallbacks;
    sum.residual = std::max(sum.residual, r.residual);
    sum.kind = r.kind;
    if (r.status != CONVERGED) sum.status = r.status;
}

// Makes one short step of the body. False if its forces are no numbers.
static bool make_short_step(Loop& loop, int index, int level, const SolveSettings& settings) {
    const Halving& h = *loop.halving;
    const Body& body = loop.body[index];
    const int64_t at = 3 * (int64_t)body.first;
    auto only = [&](int i) { return i == index; };
    if (h.predictor) {  // as backward Euler has them
        copy_nodes(body, h.predictor, loop.v);
        copy_nodes(body, h.damping_velocity, loop.v);
        std::fill(h.inertial_increment + at, h.inertial_increment + 3 * (int64_t)body.last, 0.0);
    }
    loop.moving[index] = 0;
    const int32_t* launch = h.launch + (int64_t)(level - 1) * h.launches;
    for (int k = 0; k < h.launches; ++k) run_for(loop, loop.launch[launch[k]], only);
    const SolveResult r = pcg(matrix_of(loop, body), loop.b + at, body.factor, settings, loop.y + at,
                              loop.work + WORK * (int64_t)body.first, !loop.moving[index]);
    add_solve(h.result[index], r);
    run_for(loop, loop.launch[h.advance[level - 1]], only);
    return r.status != NOT_FINITE;
}

// Makes the step of the body anew by 2^level short ones. False if one of them gives no state.
static bool make_short_steps(Loop& loop, int index, int level) {
    const Halving& h = *loop.halving;
    const Body& body = loop.body[index];
    const int count = 1 << level;
    SolveSettings settings = body.now;
    settings.dx_dv = loop.rings.dt / count;
    settings.probe = 0;
    h.result[index].status = CONVERGED;
    h.result[index].residual = 0;
    copy_nodes(body, loop.x, h.start_x);
    copy_nodes(body, loop.v, h.start_v);
    h.coefficients[0] = h.coefficients[1] = settings.dx_dv;
    bool made = true;
    for (int k = 0; k < count && made; ++k) made = make_short_step(loop, index, level, settings);
    h.coefficients[0] = h.own_coefficients[0];
    h.coefficients[1] = h.own_coefficients[1];
    copy_nodes(body, h.before, h.start_x);
    return made;
}

// Has the next step of the scheme begin as if one step of backward Euler had led to where the short ones ended.
static void begin_next(Loop& loop, int index) {
    const Halving& h = *loop.halving;
    const Body& body = loop.body[index];
    if (h.end < 0) return;
    double *end_x = h.room, *end_v = h.room + 3 * (int64_t)loop.nodes;
    copy_nodes(body, end_x, loop.x);
    copy_nodes(body, end_v, loop.v);
    for (int node = body.first; node < body.last; ++node) {
        double dv[3];
        for (int c = 0; c < 3; ++c) dv[c] = end_v[3 * (int64_t)node + c] - h.start_v[3 * (int64_t)node + c];
        rotated_back(h.rotation + 9 * (int64_t)node, dv, loop.y + 3 * (int64_t)node);
    }
    copy_nodes(body, loop.x, h.start_x);
    copy_nodes(body, loop.v, h.start_v);
    run_for(loop, loop.launch[h.end], [&](int i) { return i == index; });
    copy_nodes(body, loop.x, end_x);
    copy_nodes(body, loop.v, end_v);
    copy_nodes(body, h.before, h.start_x);
}

// Makes the step of the body again, from 2^first short steps on. Returns the halvings; 0: it is as the scheme made it.
static int make_again(Loop& loop, int index, int first, bool elastic) {
    const Halving& h = *loop.halving;
    const Body& body = loop.body[index];
    const int64_t room = 3 * (int64_t)loop.nodes;
    for (int k = 0; k < h.arrays; ++k) copy_nodes(body, h.room + k * room, h.array[k], h.width[k]);
    h.touched[0] = index;
    h.result[index] = SolveResult{0, 0, 0, CONVERGED, body.now.kind, 0, 0, 0};
    for (int level = first; level <= h.levels; ++level)
        if (make_short_steps(loop, index, level) && !ran_away(loop, index, elastic, false)) {
            begin_next(loop, index);
            h.touched[0] = -1;
            return level;
        }
    h.touched[0] = -1;
    for (int k = 0; k < h.arrays; ++k) copy_nodes(body, h.array[k], h.room + k * room, h.width[k]);
    return 0;
}

// Makes the steps of bodies again that ran away, or did so lately.
static void halve_steps(Loop& loop) {
    const Halving& h = *loop.halving;
    for (int i = 0; i < loop.bodies; ++i) {
        ShortSteps& s = h.state[i];
        h.made[i] = h.result[i].iterations = h.result[i].fallbacks = 0;
        h.result[i].seconds = 0;
        if (loop.energies->balance[i].phase == FROZEN) continue;
        const bool goes_on = s.left > 0, elastic = s.left >= 0;
        if (!elastic) ++s.left;
        if (!goes_on && !ran_away(loop, i, elastic, true)) {
            if (s.patience && ++s.calm >= CALM) s.patience = s.calm = 0;
            continue;
        }
        h.made[i] = make_again(loop, i, goes_on ? s.level : 1, elastic);
        if (goes_on && h.made[i] && h.made[i] <= s.level) {
            --s.left;
            continue;
        }
        s.patience = s.patience ? std::min(2 * s.patience, LONGEST_PATIENCE) : SHORTEST_PATIENCE;
        s.level = h.made[i];
        s.left = s.level ? s.patience : -s.patience;
        s.calm = 0;
    }
}

static void note_halving(const Halving& h, int index, Record& record) {
    const SolveResult& r = h.result[index];
    record.halvings = h.made[index];
    record.iterations += r.iterations;  // also of short steps that did not help
    record.fallbacks += r.fallbacks;
    record.solve += r.seconds;
    if (!record.halvings) return;
    record.status = r.status;
    record.residual = r.residual;
    record.kind = r.kind;
    record.nonlinear = -1;
    record.linearizations = 1;
    record.solve_error = record.step_error = NAN;
}
