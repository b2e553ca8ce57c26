// SPDX-License-Identifier: MIT
// Newton-Raphson with a line search within a step, for each body by itself (equations: sim_server/mechanics/integrator.py).
// Decisions only, shared by both devices; backends/cpu/native/newton.h and backends/gpu/newton.cu loop over a body's nodes.
//
// The unknown is the increment u (nodes, 3) of the velocity in the step. With the state before the step (index 0), predictor p
// and inertial increment r, the state after it is
//     v = v0 + u,   x = x0 + dx_dv (p0 + u),   p = 0,   r = r0 - u,
// so that the launches of a step assemble there the nonlinear residual b and the matrix A of the next linearization.
//   - Each linearization gives a search direction s. u + s is tried first. A trial is accepted if |s . b| <= SLOPE_REDUCTION
//     times its value at the start of the line search (Matthies and Strang 1979, IJNME 14), or if |b| has decreased; otherwise
//     the scale of s is reduced to where the secant of s . b is zero, by a factor from 0.1 to 0.5. A tighter line search takes
//     longer: in a slender body the minimum along a straight direction is a short step.
//   - The first direction starts at the state before the step, u = -p0: its first trial is the result of one linearization.
//   - The iteration ends when |b| <= tolerance |b of the step's first linearization|, or when b is rounding.
// With a bound of the error of positions [m]
//   - it ends, too, where P^-1 of the nonlinear residual, which is about the displacement that is left, is within the bound. That needs
//     the forces at the trial and no blocks of A; these are made where another linearization follows. Where P is a factor in the
//     material frame that displacement is added at the end, and a later linearization counts as the last one where what that leaves
//     is within the bound;
//   - linear solves end at a forcing term, choice 2 of Eisenstat and Walker 1996 (SIAM J. Sci. Comput. 17): not more exact than Newton's
//     iteration converges. Where that says that the linearization is the last one, and in any case at LINEAR_SHARE of the bound, the
//     estimated error of the solve ends it.
#pragma once
#include "error_estimate.cuh"
#include "host_device.cuh"
#include "kinds.h"

constexpr double SLOPE_REDUCTION = 0.9;
constexpr double LINEAR_SHARE = 0.3;                          // of the bound of the error: of the last linear solve
constexpr double NEAR = 2;                                    // scale of P^-1 within which it may be A^-1
constexpr double LEFT_TRUST = 1.25;                           // of the estimate of what adding P^-1 b leaves
constexpr double MOST_FORCING = 0.1, FORCING_FACTOR = 0.9;    // largest forcing term, also the first one; of the fall of |b|, squared
constexpr double MOST_FORCING_WITHOUT_FACTOR = MOST_LEFT_WITHOUT_FACTOR;
template <class T> constexpr double EPSILON = sizeof(T) == 8 ? 2.2e-16 : 1.2e-7;  // T: type in which forces are computed

enum Phase { SOLVE = 0, TRY = 1, DONE = 2, LAST = 3, SPENT = 4 };  // on a GPU LAST: over, but its error is to be estimated; SPENT: likewise, by a budget
enum Verdict { NONE_YET = 0, SHORTER = 1, TAKEN = 2, LOST = 3 };  // on a trial. LOST: no trial along the direction has a finite residual

struct Search {                        // Newton iteration of a step, of one body
    double first;                      // |b| of the first linearization
    double floor;                      // rounding of b
    double last, slope;                // |b| and s . b at the present linearization
    double scale;                      // of the search direction in the present trial
    double norm;                       // |b| at the present trial
    double residual, seconds;          // largest of the solves; sum of all
    int phase, linearizations, tried;
    int iterations, status, kind, fallbacks, verdict;
    double solve_error, step_error;    // estimated, largest of a node [m], of the last linear solve and of the state reached; NaN: not known
    double forcing;                    // relative tolerance of the next linear solve; 0: that of the settings
    double factor_scale;               // estimated error over that of P^-1, as the last solve has told; 0: not known
    int applied;                       // 1: P^-1 b is made for the next solve
    double left, moved;                // error of P^-1 b as the last correction over P^-1 b, 0: not known; that correction [m]
};

struct Limits {
    int linearizations, trials;        // most in a step; most reductions of the scale in a line search
    double tolerance;                  // of the first |b|
};

HOST_DEVICE bool is_number(double norm) { return norm <= 1.7976931348623157e308; }  // neither NaN nor infinite; norm >= 0

// to = R from, or R^T from, with R (3, 3) of a node
template <class R, class F, class T>
HOST_DEVICE void rotate_node(const R* rotation, bool back, const F* from, T* to) {
    const int row = back ? 1 : 3, column = back ? 3 : 1;
    for (int k = 0; k < 3; ++k)
        to[k] = (T)rotation[k * row] * from[0] + (T)rotation[k * row + column] * from[1] + (T)rotation[k * row + 2 * column] * from[2];
}

// One component of a node after the increment, from the state before the step.
struct NodeState { double x, v, inertial_increment, damping_velocity; };
HOST_DEVICE NodeState state_after(double x, double v, double predictor, double inertial_increment, double increment, double dx_dv,
                               double beta) {
    const double after = v + increment;
    return {x + dx_dv * (predictor + increment), after, inertial_increment - increment, beta * after / (dx_dv + beta)};
}

// Square of the elastic impulse A_ii x_i / dx_dv of node i, a = A_ii with the mass. The sum over the nodes, times the square of
// EPSILON, is the square of the rounding error of b.
template <class A, class X>
HOST_DEVICE double elastic_impulse_square(const A* a, const X* x, double mass, double dx_dv) {
    const double stiff = ((double)a[0] + a[4] + a[8]) / 3 - mass;
    return stiff > 0 ? stiff * stiff * ((double)x[0] * x[0] + (double)x[1] * x[1] + (double)x[2] * x[2]) / (dx_dv * dx_dv) : 0;
}

// At the first linearization. norm: |b|; floor: rounding error of b; kind: preconditioner asked for.
HOST_DEVICE void start_search(Search& s, double norm, double floor, int kind) {
    s = Search{};
    s.solve_error = s.step_error = not_known();
    s.first = s.norm = norm;
    s.floor = floor;
    s.kind = kind;
}

// Adds the result of a linear solve.
HOST_DEVICE void record_solve(Search& s, double residual, double seconds, int iterations, int fallbacks, int kind, int status) {
    if (residual > s.residual) s.residual = residual;
    s.seconds += seconds;
    s.iterations += iterations;
    s.fallbacks += fallbacks;
    s.kind = kind;
    s.verdict = status == NOT_FINITE && s.linearizations == 0 ? LOST : NONE_YET;
    if (status != CONVERGED) s.status = status;
    if (status == NOT_FINITE) s.phase = DONE;
}

// Begins the line search along a new direction s. slope: s . A s; norm: |A s|, which is |b| at its start up to the residual of
// the solve.
HOST_DEVICE void begin_line_search(Search& s, double slope, double norm) {
    s.slope = slope;
    s.last = norm;
    ++s.linearizations;
    s.tried = 0;
    s.scale = 1;
    s.phase = TRY;
}

// Accepts or rejects a trial with norm = |b| and slope = s . b; sets the phase and the scale of the next trial.
HOST_DEVICE int evaluate_trial(Search& s, const Limits& most, double norm, double slope) {
    const double goal = most.tolerance * s.first;
    const double change = slope < 0 ? -slope : slope, before = s.slope < 0 ? -s.slope : s.slope;
    s.norm = norm;
    const bool small = norm <= (s.floor > goal ? s.floor : goal);
    const bool good = is_number(norm) && (small || change <= SLOPE_REDUCTION * before || norm < s.last);
    if (!good && s.tried < most.trials) {
        const double root = s.slope / (s.slope - slope);
        ++s.tried;
        s.scale *= !(root > 0) ? 0.5 : root < 0.1 ? 0.1 : root > 0.5 ? 0.5 : root;  // 0.5 also of NaN
        return s.verdict = SHORTER;
    }
    s.phase = DONE;
    if (!is_number(norm)) {
        s.status = NOT_FINITE;
        return s.verdict = LOST;
    }
    if (!small && s.linearizations < most.linearizations) s.phase = SOLVE;
    else if (!small && s.status == CONVERGED) s.status = MAX_LINEARIZATIONS;
    return s.verdict = TAKEN;
}

// Relative tolerance of a linear solve. tolerance: of the settings; kind: its preconditioner.
HOST_DEVICE double solve_tolerance(const Search& s, double tolerance, int kind) {
    const bool less = kind != CHOLESKY && s.forcing > MOST_FORCING_WITHOUT_FACTOR;
    const double forcing = less ? MOST_FORCING_WITHOUT_FACTOR : s.forcing;
    return forcing > tolerance ? forcing : tolerance;
}

// Estimated error of the state of a trial [m], by z = |P^-1 b| there; NaN: not known.
HOST_DEVICE double state_error(const Search& s, double z, double dx_dv) {
    const double e = s.factor_scale > 0 ? dx_dv * s.factor_scale * z : not_known();
    return e < s.solve_error ? s.solve_error : e;
}

// |b| at the start of the present linearization.
HOST_DEVICE double norm_before(const Search& s) { return s.linearizations == 1 ? s.first : s.last; }

// Whether P^-1 b, which is made, takes off most of the error of a state that is exact enough. trust: in the factor.
HOST_DEVICE bool adds_remaining(const Search& s, double trust) {
    return s.applied && trust <= WARPED_TRUST && s.factor_scale < NEAR && s.factor_scale > 1 / NEAR;
}

// Part of the error that adding P^-1 b leaves: by P, as in the last correction, and by the change of A in that correction, which is as
// large, relative to A, as the error is to the correction. estimate: of the error [m].
HOST_DEVICE double part_left(const Search& s, double estimate, double trust) {
    const double part = s.left > 0 && adds_remaining(s, trust) ? LEFT_TRUST * (s.left + estimate / s.moved) : 1;
    return part < 1 ? part : 1;
}

// After a trial that was taken. estimate: of its error [m]; NaN: not known. trust: in the factor. Ends the iteration where the error,
// less what is added, is within position, and returns whether it is; else sets the forcing term.
HOST_DEVICE bool bound_error(Search& s, double estimate, double trust, double position) {
    const double left = part_left(s, estimate, trust) * estimate;
    if (is_exact_enough(left, trust_of(s.kind, trust), position, false)) {
        s.step_error = left;
        s.phase = DONE;
        if (s.status == MAX_LINEARIZATIONS) s.status = CONVERGED;
        return true;
    }
    s.step_error = estimate;
    const double fall = s.norm / norm_before(s), forcing = FORCING_FACTOR * fall * fall;
    const bool last = is_exact_enough(forcing * estimate, trust_of(s.kind, trust), position, false);
    s.forcing = last ? 0 : forcing < MOST_FORCING ? forcing : MOST_FORCING;
    return false;
}

// A component of the increment after a verdict. NaN if no trial of the first linearization had a finite residual: then y is NaN,
// too, and the kernel `advance` takes the body back, as after one linearization (backends/cpu/native/pcg.h).
HOST_DEVICE double increment_after(const Search& s, double increment, double direction) {
    if (s.verdict == LOST && s.linearizations <= 1) return 0 * s.norm;  // |b| is infinite or NaN
    return s.verdict == TAKEN ? increment + s.scale * direction : increment;
}

// Nonlinear residual at the end over that of the first linearization.
HOST_DEVICE double residual_ratio(const Search& s) { return s.first > 0 ? s.norm / s.first : 0; }
