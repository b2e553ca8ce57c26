// SPDX-License-Identifier: MIT
// The Rosenbrock-W step on a CPU (method: mechanics/rosenbrock.py; nodal kernels: kernels/rosenbrock.cu).
//
// A step is a list of attempts. All bodies make theirs together, each in its own form; those whose estimate is too large then make
// another: FACTOR, ITERATE, EULER (euler_form.h). Launches run for the bodies that take part.
#pragma once
#include <algorithm>

#include "loop.h"
#include "momentum.h"

// Runs a launch for the bodies with take_part(i). One whose items are not grouped by body runs for all of them.
template <class F> static void run_for(const Loop& loop, const Launch& l, F take_part) {
    int left = 0;
    for (int i = 0; i < loop.bodies; ++i) left += take_part(i);
    if (!left) return;
    if (!l.parts || left == loop.bodies) { run(l, loop.threads); return; }
    each_body(loop, [&](int i) {
        if (!take_part(i) || l.parts[i] >= l.parts[i + 1]) return;
        run_items(l, l.parts[i], l.parts[i + 1], loop.threads);
    });
}

static bool copy_wanted(const Body& body) { return body.snapshot.load(std::memory_order_acquire) && body.ahead < 0; }

// True if a copy of A in this step is to be of backward Euler, with contacts: of bodies that have touched something for long.
static bool copied_as_of_euler(const Loop& loop, int index) { return loop.euler->touching[index] > (loop.stages ? PATIENCE : 0); }

// True if a factor is of such a copy, or may be: it is known of the last 64 steps.
static bool is_of_euler(const StageState& s, int64_t factor_step, int64_t now) {
    const int64_t age = now - factor_step;
    return age < 64 ? s.euler_copies >> age & 1 : factor_step <= s.euler_step;
}

// Chooses the form of a body's first attempt, before the step is assembled. whole: A is wanted whatever the form.
static void choose_form(Loop& loop, int index, bool whole) {
    const Stages& stages = *loop.stages;
    const Body& body = loop.body[index];
    StageState& s = stages.state[index];
    const Factor* factor = body.factor;
    if (factor && s.factor_step != factor->step) {  // a new one
        s.factor_step = factor->step;
        s.patience = 0;
        s.of_euler = is_of_euler(s, factor->step, loop.rings.step);
    }
    const bool alone = stages.factor_alone && factor && body.now.kind == CHOLESKY && s.patience == 0 && !s.of_euler;
    s.form = loop.euler->takes[index] ? EULER : alone ? FACTOR : ITERATE;
    s.assembled = whole || s.form == ITERATE || copy_wanted(body);
}

// True if elements were removed since the matrix of the body's factor.
static bool is_cut_since(const Body& body) {
    const CutNodes* cut = body.correction.cut;
    for (int i = 0; cut && i < cut->nodes; ++i)
        if (cut->changed_at[i] > cut->start_time + (body.factor->step + 0.5) * cut->dt) return true;
    return false;
}

// After the forces of the first stage are evaluated: whether factors know the springs of grabs, or are corrected for them. Where one
// does not, the body iterates in this step, and so does one whose holder moves: the check of its factor knows nothing of that.
static void check_corrections(Loop& loop) {
    const Stages& stages = *loop.stages;
    for (int i = 0; i < loop.bodies; ++i) {
        StageState& s = stages.state[i];
        Body& body = loop.body[i];
        s.corrects = s.misses = false;
        if (s.form != FACTOR) continue;
        s.misses = loop.stages->held_moves[i] || is_cut_since(body);
        if (!s.misses && body.correction.capacity > 0) {
            s.corrects = Corrected{body.correction, matrix_of(loop, body), *body.factor}.prepare();
            s.misses = body.correction.missed;
        }
        if (s.misses) s.form = ITERATE;
    }
    for (int k = 0; k < loop.before; ++k) run_for(loop, loop.launch[k], [&](int i) { return stages.state[i].misses != 0; });
}

static void note(SolveResult& sum, const SolveResult& r) {
    sum.seconds += r.seconds;
    sum.iterations += r.iterations;
    sum.fallbacks += r.fallbacks;
    sum.kind = r.kind;
    sum.at_rest = r.at_rest;
    if (!(r.residual <= sum.residual)) sum.residual = r.residual;
    if (r.status != CONVERGED) sum.status = r.status;
    sum.solve_error = std::isnan(sum.solve_error) ? r.solve_error : sum.solve_error + r.solve_error;
}

// The attempt is made again: what it cost counts, how it ended does not.
static void forget(SolveResult& sum) {
    sum.status = CONVERGED;
    sum.residual = 0;
    sum.solve_error = NAN;
}

struct FirstStage {  // views of a body's part of Stages::first_stage, (3 n,) each
    double *start, *b, *y;
    FirstStage(const Stages& stages, const Body& body) {
        start = stages.first_stage + 9 * (int64_t)body.first;
        b = start + 3 * (body.last - body.first);
        y = b + 3 * (body.last - body.first);
    }
};

// |y_1 . (b_1 - A y_1)| / |y_1 . b_1| of the first stage, from the forces of the second, b (kernels/step_form.h).
static double inconsistency(const Loop& loop, const Body& body, const double* b) {
    const Stages& stages = *loop.stages;
    const FirstStage first(stages, body);
    double off = 0, all = 0;
    for (int i = 0; i < body.last - body.first; ++i) {
        const int node = body.first + i;
        for (int k = 3 * i; k < 3 * i + 3; ++k) {
            off += first.y[k] * first_residual(first.start[k], first.b[k], b[k], first.y[k], stages.share[node], stages.weight[node],
                                               stages.mass[node], stages.diagonal[node]);
            all += first.y[k] * first.b[k];
        }
    }
    return all != 0 ? std::fabs(off / all) : 0;
}

// y = P^-1 b. False if P is not positive definite there or, in the second stage, the factor proves inconsistent.
static bool apply_alone(Loop& loop, int index, bool first) {
    StageState& s = loop.stages->state[index];
    Body& body = loop.body[index];
    const BlockCsr A = matrix_of(loop, body);
    const int n = A.size();
    const double *b = loop.b + 3 * (int64_t)body.first, begin = now();
    double *y = loop.y + 3 * (int64_t)body.first, *work = loop.work + WORK * (int64_t)body.first;
    const FirstStage kept(*loop.stages, body);
    const double b2 = dot(n, b, b);
    SolveResult out{0, 0, 0, CONVERGED, CHOLESKY, 0};
    bool well = true;
    if (first) {
        std::copy(y, y + n, kept.start);
        std::copy(b, b + n, kept.b);
    } else {
        out.residual = inconsistency(loop, body, b);
        well = out.residual <= INCONSISTENT;
    }
    if (!std::isfinite(b2)) {
        out.status = NOT_FINITE;
        out.residual = std::sqrt(b2);
        for (int i = 0; i < n; ++i) y[i] = NAN;
    } else if (b2 == 0) {
        for (int i = 0; i < n; ++i) y[i] = 0;
    } else if (well) {
        Preconditioner P{A, body.factor, CHOLESKY, nullptr, work, 1, &body.correction, s.corrects != 0};
        const double zr = P.apply(b, std::sqrt(b2), y);
        well = zr > 0 && zr < INFINITY;
    }
    if (first) std::copy(y, y + n, kept.y);
    if (!well) out.fallbacks = 1;
    out.seconds = now() - begin;
    note(s.result, out);
    return well;
}


static void iterate(Loop& loop, int index, bool first) {
    StageState& s = loop.stages->state[index];
    Body& body = loop.body[index];
    const int64_t at = 3 * (int64_t)body.first;
    SolveSettings settings = body.now;
    settings.dx_dv = loop.rings.dt;
    if (s.form != EULER) {
        settings.dx_dv *= first ? BY_FIRST : BY_SECOND;
        settings.position /= 2;  // of each stage
    }
    note(s.result, pcg(matrix_of(loop, body), loop.b + at, body.factor, settings, loop.y + at, loop.work + WORK * (int64_t)body.first,
                       !loop.moving[index], &body.correction, s.form == EULER ? WARM_START : GIVEN_START));
}

// Solves of the bodies that take part. first: of the first stage.
template <class F> static void solve_stage(Loop& loop, bool first, F take_part) {
    each_body(loop, [&](int i) {
        StageState& s = loop.stages->state[i];
        if (!take_part(i) || s.form == FAILED) return;
        if (!loop.moving[i] && s.form != EULER) {
            s.result.kind = loop.body[i].now.kind;
            s.result.at_rest = 1;
            return;
        }
        if (s.form != FACTOR) { iterate(loop, i, first); return; }
        if (apply_alone(loop, i, first)) return;
        s.patience = PATIENCE;
        s.form = FAILED;
    });
}

// One attempt of the bodies that take part, from the first solve on. Returns whether one has to make another.
template <class F> static bool make_attempt(Loop& loop, F take_part) {
    const Stages& stages = *loop.stages;
    auto moves = [&](int i) { return take_part(i) && loop.moving[i]; };
    run_for(loop, loop.launch[stages.remember], [&](int i) { return take_part(i) && stages.state[i].form == ITERATE; });
    for (int i = 0; i < loop.bodies; ++i) {
        StageState& s = stages.state[i];
        if (!take_part(i)) continue;
        s.missing = {};
        s.free = stages.unheld[i] && loop.moving[i] && add_impulses(loop, loop.body[i], loop.x, s.missing);
    }
    solve_stage(loop, true, take_part);
    run_for(loop, loop.launch[stages.second], take_part);
    for (int k = 0; k < stages.agains; ++k) run_for(loop, loop.launch[stages.again[k]], moves);
    for (int i = 0; i < loop.bodies; ++i) {
        StageState& s = stages.state[i];
        if (take_part(i) && s.free) s.free = add_impulses(loop, loop.body[i], stages.start_x, s.missing);
    }
    solve_stage(loop, false, take_part);
    run_for(loop, loop.launch[stages.finish], take_part);
    for (int k = 0; k < stages.ends; ++k) run_for(loop, loop.launch[stages.end[k]], take_part);
    bool again = false;
    for (int i = 0; i < loop.bodies; ++i) {
        if (!take_part(i)) continue;
        StageState& s = stages.state[i];
        double most = 0;
        for (int k = loop.body[i].first; k < loop.body[i].last; ++k)
            if (most == most && !(stages.estimate[k] <= most)) most = stages.estimate[k];  // NaN stays
        s.estimate = most;
        s.accepted = s.form != FAILED && most <= stages.bound[i];
        again = again || !s.accepted;
        if (s.accepted && s.free) set_momenta(loop, loop.body[i], s.missing);
    }
    run_for(loop, loop.launch[stages.prepare], [&](int i) { return take_part(i) && stages.state[i].accepted && stages.state[i].free; });
    return again;
}

// Makes the steps by stages of bodies that touch nothing, whose first stage is assembled, and integrates. Those that are to take
// backward Euler are marked.
static void make_stages(Loop& loop) {
    const Stages& stages = *loop.stages;
    int32_t* takes = loop.euler->takes;
    for (int i = 0; i < loop.bodies; ++i) {
        StageState& s = stages.state[i];
        s.result = SolveResult{0, 0, 0, CONVERGED, loop.body[i].now.kind, 0};
        if (s.patience > 0) --s.patience;
        if (takes[i]) s.estimate = NAN;
        s.accepted = takes[i];
    }
    auto left = [&](int i) { return !stages.state[i].accepted; };
    auto iterates = [&](int i) { return left(i) && stages.state[i].form == ITERATE; };
    if (!make_attempt(loop, [&](int i) { return !takes[i]; })) return;
    bool again = false;
    for (int i = 0; i < loop.bodies; ++i) {
        StageState& s = stages.state[i];
        if (s.accepted || s.form == ITERATE) { if (!s.accepted) s.form = EULER; continue; }
        s.form = ITERATE;
        s.patience = PATIENCE;
        forget(s.result);
        again = true;
    }
    if (again) {
        run_for(loop, loop.launch[stages.restore], iterates);
        for (int k = 0; k < loop.before; ++k) run_for(loop, loop.launch[k], iterates);
        make_attempt(loop, iterates);
        for (int i = 0; i < loop.bodies; ++i)
            if (iterates(i)) stages.state[i].form = EULER;
    }
    for (int i = 0; i < loop.bodies; ++i)
        if (left(i)) takes[i] = 1;
}
