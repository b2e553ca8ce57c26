// SPDX-License-Identifier: MIT
// Newton-Raphson within a step on a CPU (method: kernels/newton_line_search.cuh).
#pragma once
#include <algorithm>

#include "loop.h"

struct BodyRoom {  // views of a body's part of Newton::room, (3 n,) each
    int n;
    double *x, *v, *predictor, *inertial_increment, *increment, *direction;
    BodyRoom(const Newton& newton, const Body& body) : n(3 * (body.last - body.first)) {
        x = newton.room + 18 * (int64_t)body.first;
        v = x + n; predictor = v + n; inertial_increment = predictor + n;
        increment = inertial_increment + n; direction = increment + n;
    }
};

static double norm(int n, const double* a) { return std::sqrt(dot(n, a, a)); }

// Rounding error of b.
static double rounding(const Loop& loop, const Body& body) {
    const Newton& newton = *loop.newton;
    double sum = 0;
    for (int i = body.first; i < body.last; ++i) {
        int k = loop.row_start[i], end = loop.row_start[i + 1];
        if (end - k < 2) continue;  // fixed
        while (loop.columns[k] != i) ++k;
        sum += elastic_impulse_square(loop.values + 9 * (int64_t)k, loop.x + 3 * i, newton.mass[i], newton.dx_dv);
    }
    return EPSILON<double> * std::sqrt(sum);
}

static void begin_search(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    BodyRoom room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    for (int k = 0; k < room.n; ++k) {
        room.x[k] = loop.x[at + k];
        room.v[k] = loop.v[at + k];
        room.predictor[k] = newton.predictor[at + k];
        room.inertial_increment[k] = newton.inertial_increment[at + k];
        room.increment[k] = -room.predictor[k];
    }
    start_search(newton.search[index], norm(room.n, loop.b + at), rounding(loop, body), body.now.kind);
    if (body.now.position > 0) newton.search[index].forcing = MOST_FORCING;
}

// Sets the state to that after increment + scale * direction.
static void set_state(Loop& loop, const Body& body, double scale) {
    const Newton& newton = *loop.newton;
    BodyRoom room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    for (int k = 0; k < room.n; ++k) {
        const double increment = room.increment[k] + scale * room.direction[k], beta = newton.beta[body.first + k / 3];
        const NodeState p =
            state_after(room.x[k], room.v[k], room.predictor[k], room.inertial_increment[k], increment, newton.dx_dv, beta);
        loop.x[at + k] = p.x;
        loop.v[at + k] = p.v;
        newton.predictor[at + k] = 0;
        newton.inertial_increment[at + k] = p.inertial_increment;
        newton.damping_velocity[at + k] = p.damping_velocity;
        if (newton.moved) newton.moved[at + k] = room.predictor[k] + increment;
    }
}

// to = R from; back: R^T from
static void rotate(const Newton& newton, const Body& body, bool back, const double* from, double* to) {
    for (int i = 0; i < body.last - body.first; ++i)
        rotate_node(newton.rotation + 9 * (int64_t)(body.first + i), back, from + 3 * i, to + 3 * i);
}

// Wall time of the forces at a trial and of P^-1 of the residual there, as measured.
static double seconds_of_trial(const Newton& newton, const Search& search) {
    return newton.forces_seconds + search.seconds / std::max(1, search.iterations);
}

// Scale of P^-1 for the estimate at a trial, 0: not known. It depends on how smooth the error is: that of a trial is about as smooth as
// the one at the start of the solve before.
static double scale_of(const Search& search, const SolveResult& r) {
    const double scale = std::max(r.factor_scale, r.start_scale);
    return scale > 0 ? scale : search.factor_scale;
}

// One linearization, if it is the body's turn.
static void solve(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    Body& body = loop.body[index];
    Search& search = newton.search[index];
    if (search.phase != SOLVE) return;
    BodyRoom room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    double *y = loop.y + at, *work = loop.work + WORK * (int64_t)body.first, *material = work, *product = work + room.n;
    const BlockCsr A = matrix_of(loop, body);
    SolveSettings settings = body.now;
    settings.warm_start = settings.warm_start && search.linearizations == 0;  // the last step's is no guess for a correction
    settings.tolerance = solve_tolerance(search, settings.tolerance, body.factor ? settings.kind : BLOCK_JACOBI);
    settings.position *= LINEAR_SHARE;
    settings.factor_scale = search.factor_scale;
    if (settings.budget < 0) settings.budget = std::min(-1.0, settings.budget + search.iterations);
    if (settings.deadline > 0) settings.deadline -= seconds_of_trial(newton, search);
    const double* z = work + room.n;
    if (search.applied) std::copy(z, z + room.n, room.direction);  // the direction is made below
    SolveResult r = pcg(A, loop.b + at, body.factor, settings, y, work, !loop.moving[index], &body.correction,
                        search.applied ? APPLIED_START : WARM_START);
    record_solve(search, r.residual, r.seconds, r.iterations, r.fallbacks, r.kind, r.status);
    if (search.applied) {
        const BodyNodes nodes{body.last - body.first};
        search.moved = settings.dx_dv * nodes.peak(y);
        search.left = (nodes.change(y, room.direction) + r.solve_error / settings.dx_dv) / nodes.peak(room.direction);
    }
    search.applied = 0;
    search.solve_error = r.solve_error;
    search.factor_scale = scale_of(search, r);
    if (search.phase == DONE) {
        for (int k = 0; k < room.n; ++k) room.increment[k] = increment_after(search, room.increment[k], room.direction[k]);
        return;
    }
    rotate(newton, body, false, y, room.direction);
    if (search.linearizations == 0)
        for (int k = 0; k < room.n; ++k) room.direction[k] += room.predictor[k];
    rotate(newton, body, true, room.direction, material);
    const double slope = multiply(A, material, product);
    begin_line_search(search, slope, norm(room.n, product));
    set_state(loop, body, 1);
}

// Estimated error of the state reached [m], by P^-1 of the nonlinear residual; NaN: not known. The next solve may go on from it.
static double remaining_error(Loop& loop, int index) {
    Body& body = loop.body[index];
    Search& search = loop.newton->search[index];
    if (!loop.moving[index]) return 0;
    const double start = now();
    const double* b = loop.b + 3 * (int64_t)body.first;
    const double z = apply_to(matrix_of(loop, body), b, body.factor, search.kind, body.now.omega, loop.work + WORK * (int64_t)body.first,
                              &body.correction);
    search.applied = search.kind == CHOLESKY && body.now.kind == CHOLESKY && z > 0;
    search.seconds += now() - start;
    return state_error(search, z, body.now.dx_dv);
}

// Ends the search where the estimated error is within the bound; returns whether it is.
static bool bound_error(Loop& loop, int index) {
    Search& search = loop.newton->search[index];
    const SolveSettings& settings = loop.body[index].now;
    return bound_error(search, remaining_error(loop, index), settings.trust, settings.position);
}

// Adds P^-1 of the nonlinear residual, which is made, to the increment: with a factor near A it takes off most of what is left.
static void add_remaining(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    BodyRoom room(newton, body);
    rotate(newton, body, false, loop.work + WORK * (int64_t)body.first + room.n, room.direction);
    for (int k = 0; k < room.n; ++k) room.increment[k] += room.direction[k];
}

// Ends the step where its budget does not allow another linearization, or ended a solve.
static void end_by_budget(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    Search& search = newton.search[index];
    const double next = newton.blocks_seconds + seconds_of_trial(newton, search) + 2 * search.seconds / std::max(1, search.iterations);
    const bool spent = body.now.deadline > 0 && search.phase == SOLVE && now() + next > body.now.deadline;
    const bool was_spent = body.now.most_linearizations > 0 && search.phase == DONE && search.verdict == TAKEN;
    if (spent || was_spent) {
        search.phase = DONE;
        search.status = BUDGET;
    }
    if (search.status == BUDGET && search.verdict == TAKEN && !(body.now.position > 0)) search.step_error = remaining_error(loop, index);
}

// Evaluates a trial: accept, reduce the scale, or end. Returns the phase.
static int judge(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    Search& search = newton.search[index];
    if (search.phase != TRY) return search.phase;
    BodyRoom room(newton, body);
    const double* b = loop.b + 3 * (int64_t)body.first;
    double* material = loop.work + WORK * (int64_t)body.first;
    rotate(newton, body, true, room.direction, material);
    Limits most = newton.most;
    if (body.now.most_linearizations > 0) most.linearizations = body.now.most_linearizations;
    if (search.status == BUDGET) most.linearizations = search.linearizations;
    const int verdict = evaluate_trial(search, most, norm(room.n, b), dot(room.n, material, b));
    if (verdict == SHORTER) {
        set_state(loop, body, search.scale);
        return search.phase;
    }
    for (int k = 0; k < room.n; ++k) room.increment[k] = increment_after(search, room.increment[k], room.direction[k]);
    if (verdict == TAKEN && body.now.position > 0 && bound_error(loop, index) && adds_remaining(search, body.now.trust))
        add_remaining(loop, index);
    if (body.now.step_budget > 0 || body.now.most_linearizations > 0) end_by_budget(loop, index);
    return search.phase;
}

// Restores the state before the step and sets y so that `advance` reaches the state that was found.
static void end_search(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    BodyRoom room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    for (int k = 0; k < room.n; ++k) {
        loop.x[at + k] = room.x[k];
        loop.v[at + k] = room.v[k];
        newton.predictor[at + k] = room.predictor[k];
        newton.inertial_increment[at + k] = room.inertial_increment[k];
        if (newton.moved) newton.moved[at + k] = room.predictor[k];
    }
    rotate(newton, body, true, room.increment, loop.y + at);
}

// The search in the form of one solve.
static SolveResult as_solve_result(const Search& search) {
    return SolveResult{search.residual, search.seconds, search.iterations, search.status, search.kind, search.fallbacks, 0, 0, search.solve_error};
}
