// SPDX-License-Identifier: MIT
// Newton-Raphson within a step of backward Euler in contact, on a CPU (search: kernels/newton_line_search.cuh; passes: contact.h). The
// residual of the step has the forces of contact in it,
//     r(u) = b(u) + i H^T f(s),   s = c (p + u) at the points of the rows,
// with rows as they were detected at the start of the step. A linearization of an island is
//   - elasticity, anew in the state reached; the passes, with the law as it is there, which end within the smaller one of the tolerances
//     of contact and of the search. Their whole change of velocity is the direction of the line search;
//   - trials along it, judged by r. What limits friction is the normal force at the trial.
// Bodies of an island have one search. A body that touches nothing yet searches as without contact.
//
// When all searches are over the paths of the whole step are swept. What enters something gets rows there, and the search of its island
// goes on from the state reached, by one linearization at least, at most ROUNDS times; what is still left is held back. Forces are kept
// for the next step once, at the end.
#pragma once
#include <cstring>

#include "contact.h"
#include "newton.h"

struct ContactSearch : Passes {
    const Newton& newton;
    Search& search;  // of the first body; the others have copies

    ContactSearch(Loop& loop, int island) : Passes(loop, island), newton(*loop.newton), search(newton.search[bodies[0]]) {}

    bool touches() const { return newton.most_touching[bodies[0]] > 0; }
    // No trial of the first linearization had a finite residual: the bodies go back.
    bool lost() const { return search.status == NOT_FINITE && search.linearizations <= 1; }
    void share() const {
        for (int m = 1; m < count; ++m) newton.search[bodies[m]] = search;
    }
    void set_states(double scale) const {
        for (int m = 0; m < count; ++m) set_state(loop, loop.body[bodies[m]], scale);
    }
    void move_on() const {
        for (int m = 0; m < count; ++m) {
            BodyRoom room(newton, loop.body[bodies[m]]);
            for (int k = 0; k < room.n; ++k) room.increment[k] = increment_after(search, room.increment[k], room.direction[k]);
        }
    }
    // dy: the direction in the material frame as it is now
    void turn_direction() const {
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            rotate(newton, body, true, BodyRoom(newton, body).direction, dy + 3 * (int64_t)body.first);
        }
    }
    double along_direction() const {
        double sum = 0;
        each_entry([&](int64_t k) { sum += dy[k] * r[k]; });
        return sum;
    }

    // One search for bodies that had their own.
    void join() const {
        double first = 0, floor = 0;
        for (int m = 0; m < count; ++m) {
            const Search& s = newton.search[bodies[m]];
            first += s.first * s.first;
            floor += s.floor * s.floor;
            search.linearizations = std::max(search.linearizations, s.linearizations);
        }
        search.first = std::sqrt(first);
        search.floor = std::sqrt(floor);
    }

    void begin() {
        const bool touching = choose_set() > 0 || count > 1;
        for (int m = 0; m < count; ++m) newton.most_touching[bodies[m]] = touching ? newton.most.linearizations : 0;
        if (touching) {
            join();
            share();
            return;
        }
        rows.actives = 0;
        tell_correction(rows, loop.body[bodies[0]]);
    }

    // Goes on with rows that a sweep has made. Bodies that were one island have copies of its search.
    void resume() const {
        for (int m = 0; m < count; ++m) {
            const Search& s = newton.search[bodies[m]];
            search.first = std::max(search.first, s.first);
            search.floor = std::max(search.floor, s.floor);
            search.linearizations = std::max(search.linearizations, s.linearizations);
        }
        if (search.status == MAX_LINEARIZATIONS) search.status = CONVERGED;
        search.step_error = NAN;  // what was known of it is of a motion without these contacts
        search.phase = SOLVE;
        const int most = std::max(newton.most.linearizations, search.linearizations + 1);
        for (int m = 0; m < count; ++m) {
            newton.most_touching[bodies[m]] = most;
            newton.entered[bodies[m]] = 1;
        }
        share();
    }

    // One linearization, if it is the island's turn.
    void linearize() {
        if (search.phase != SOLVE) return;
        if (!touches()) { ::solve(loop, bodies[0]); return; }
        const bool first = search.linearizations == 0;
        if (count > 1) IslandSolver::make_modes(loop, c, bodies, count);
        if (first) start();
        else begin_here();
        const bool rested = first && rests();
        solve(first && !rested, rested);
        ContactReport& total = c.report[bodies[0]];
        total.passes += report.passes;
        total.residual = report.residual;
        if (result.status == NOT_FINITE && first) search.norm = NAN;
        record_solve(search, result.residual, result.seconds, result.iterations, result.fallbacks, result.kind, result.status);
        search.solve_error = result.solve_error;
        if (search.phase == DONE) {
            move_on();
            share();
            return;
        }
        search.first = std::max(search.first, given);
        set_direction(first);
        set_states(1);
        share();
    }

    // y = 0: the state is that of A and b
    void begin_here() {
        each_entry([&](int64_t k) {
            y[k] = 0;
            left[k] = b[k];
        });
        move_points();
    }

    // The change that the passes found, as direction of a line search; in the first linearization from the state before the step.
    void set_direction(bool first) {
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            const BodyRoom room(newton, body);
            rotate(newton, body, false, y + 3 * (int64_t)body.first, room.direction);
            for (int k = 0; first && k < room.n; ++k) room.direction[k] += room.predictor[k];
        }
        turn_direction();
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            const int64_t at = 3 * (int64_t)body.first;
            multiply(matrix_of(loop, body), dy + at, before + at);
        }
        each_entry([&](int64_t k) { left[k] += before[k]; });
        each_row([&](int k, RowState& s) {
            double u[3] = {0, 0, 0};
            rows.gather(k, dy, u);
            for (int m = 0; m < 3; ++m) s.s[m] -= c.dx_dv * u[m];
        });
        apply_law(false);
        const double size = balance();
        begin_line_search(search, along_direction(), size);
    }

    // Evaluates a trial. True if the search goes on.
    bool judge() {
        if (!touches()) return ::judge(loop, bodies[0]) != DONE;
        if (search.phase != TRY) return search.phase != DONE;
        begin_here();
        each_row([&](int k, RowState& s) {
            if (s.limit > 0) s.limit = rows.force(k, s.s, 0, false).normal;
            bound_dual(rows.row(k), s.limit, s.dual);
        });
        apply_law(false);
        const double size = balance();
        turn_direction();
        Limits most = newton.most;
        most.linearizations = newton.most_touching[bodies[0]];
        if (search.linearizations == 1 || newton.entered[bodies[0]]) search.last = INFINITY;
        if (evaluate_trial(search, most, size, along_direction()) == SHORTER) set_states(search.scale);
        else move_on();
        if (search.verdict != SHORTER) newton.entered[bodies[0]] = 0;
        share();
        return search.phase != DONE;
    }

    // Looks where y takes the island, from the start of the step. Gives what enters an obstacle rows there. Returns whether something
    // does, so that its search has to go on.
    bool sweep() {
        if (touches() && search.status == MAX_LINEARIZATIONS && c.report[bodies[0]].residual > c.tolerance) search.status = CONTACT;
        for (int m = 0; m < count; ++m) c.result[bodies[m]] = as_solve_result(search);
        if (lost()) return false;
        move_points();
        const bool acts = apply_law(false);
        return sweep_obstacles(*this) || (!touches() && acts);
    }
};

// Searches until all islands are done, and takes the bodies back to the start of the step; y is then the whole change of velocity.
static void search_islands(Loop& loop) {
    const double begin = now();
    double solving = 0;
    auto searching = [&](int i) { return loop.newton->search[i].phase != DONE; };
    auto any = [&] {
        bool found = false;
        for (int i = 0; i < loop.bodies; ++i) found = found || searching(i);
        return found;
    };
    while (any()) {
        const double t = now();
        each_island(loop, [&](int i) { ContactSearch(loop, i).linearize(); });
        solving += now() - t;
        for (int k = 0; k < loop.before; ++k)
            if (k < loop.newton->detect || k >= loop.newton->detect + loop.newton->detects) run_for(loop, loop.launch[k], searching);
        each_island(loop, [&](int i) { ContactSearch(loop, i).judge(); });
    }
    for (int i = 0; i < loop.bodies; ++i) end_search(loop, i);
    loop.assemble_seconds += now() - begin - solving;
}

// Sweeps the paths of the step. Marks in `entered` the bodies whose search has to go on; returns whether there are such. enters: of each
// body, whether its path is into an obstacle
static bool sweep_paths(Loop& loop, int round, char* enters) {
    Contact& c = *loop.contact;
    int32_t* found = loop.newton->entered;
    std::fill_n(found, loop.bodies, 0);
    each_island(loop, [&](int i) {
        ContactSearch s(loop, i);
        const bool into = s.sweep();
        for (int m = 0; m < s.count; ++m) {
            enters[s.bodies[m]] = into;
            found[s.bodies[m]] = into && round < ROUNDS && s.search.status != NOT_FINITE;
        }
    });
    if (c.pair_first >= 0) {
        const PairDetection pairs(loop, c, loop.y);
        if (round == ROUNDS) pairs.hold_back(c.room, loop.y);
        else if (pairs.sweep(c.room, round == 0))
            for (int i = 0; i < loop.bodies; ++i) found[i] = found[i] || c.touched[i];
    }
    bool any = false;
    for (int i = 0; i < loop.bodies; ++i) any = any || found[i];
    return any;
}

static void resume_searches(Loop& loop) {
    const Newton& newton = *loop.newton;
    find_islands(loop);
    each_island(loop, [&](int i) {
        const ContactSearch s(loop, i);
        bool enters = false;
        for (int m = 0; m < s.count; ++m) enters = enters || newton.entered[s.bodies[m]];
        if (s.search.status == NOT_FINITE) return;
        s.set_states(0);  // also of those that are done: launches that do not tell bodies apart run for all
        if (enters) s.resume();
    });
}

// The step of all bodies.
static void search_in_contact(Loop& loop) {
    static thread_local std::vector<char> enters;
    Contact& c = *loop.contact;
    enters.assign(loop.bodies, 0);
    find_islands(loop);
    for (int i = 0; i < loop.bodies; ++i) {
        begin_search(loop, i);
        c.report[i] = {0, 0, 0, NAN, 0};
    }
    each_island(loop, [&](int i) { ContactSearch(loop, i).begin(); });
    search_islands(loop);
    for (int round = 0; round <= ROUNDS && sweep_paths(loop, round, enters.data()); ++round) {
        resume_searches(loop);
        search_islands(loop);
    }
    hold_islands_back(loop, enters.data());
    for (int i = 0; i < c.islands; ++i) {
        Passes p(loop, i);
        p.conclude(true);  // that the law does not hold is known since the sweep
        for (int m = 0; m < p.count; ++m) loop.newton->search[p.bodies[m]].status = c.result[p.bodies[m]].status;
        ContactEnd(p, p.result, p.report).finish();
    }
}
