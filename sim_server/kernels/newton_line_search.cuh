// SPDX-License-Identifier: MIT
// Newton-Raphson within a step, for each body by itself (sim_server/mechanics/integrator.py has the equations): what both devices share of
// it; backends/cpu/native/newton.h and backends/gpu/newton.cu go through a body's nodes. What a body's velocity gains in the step is searched for: gain
// (nodes, 3), from which all of the state follows,
//     v = v0 + gain,   x = x0 + reach (ahead0 + gain),   ahead = 0,   carried = carried0 - gain,
// so that what the launches assemble at a trial is the nonlinear residual b there and the matrix A of the next linearization.
//   - A linearization gives a way, tried whole at first. It is taken if |way . b| <= 0.9 of what that was at its beginning
//     (the line search of Matthies and Strang 1979, IJNME 14) or if |b| has fallen; else a part of it is tried: up to where
//     the secant of way . b has its zero, at least a tenth and at most a half. A tighter search takes longer: in a slender
//     body what minimizes along a straight way is a short step.
//   - The first way begins at the state before the step, gain = -ahead0, and its first trial is what one linearization gives.
//   - The search is over when |b| <= tolerance |b of the step's first linearization|, or when b is rounding.
// Who includes this has Status (backends/cpu/native/pcg.h, backends/gpu/pcg_structs.cuh).
#pragma once
#include "host_device.cuh"

constexpr double SLACK = 0.9;
template <class T> constexpr double EPSILON = sizeof(T) == 8 ? 2.2e-16 : 1.2e-7;  // of what forces are reckoned in

enum Phase { SOLVE = 0, TRY = 1, DONE = 2 };
enum Verdict { NONE_YET = 0, SHORTER = 1, TAKEN = 2, LOST = 3 };  // on a trial. LOST: there is no state on the way

struct Search {                        // for the state at the end of a step, of one body
    double first;                      // |b| of the first linearization
    double floor;                      // rounding of b
    double last, slope;                // |b| and way . b at the present linearization
    double scale;                      // of the way that is tried
    double norm;                       // |b| at what is tried
    double residual, seconds;          // largest of the solves; of all
    int phase, linearizations, tried;
    int iterations, status, kind, fallbacks, verdict;
};

struct Limits {
    int linearizations, trials;        // most of them in a step; of shorter ways in a line search
    double tolerance;                  // of the first |b|
};

ANYWHERE bool is_number(double norm) { return norm <= 1.7976931348623157e308; }  // neither NaN nor infinite; norm >= 0

// to = R from, or R^T from, with R (3, 3) of a node
template <class R, class F, class T>
ANYWHERE void turn_node(const R* rotation, bool back, const F* from, T* to) {
    const int row = back ? 1 : 3, column = back ? 3 : 1;
    for (int k = 0; k < 3; ++k)
        to[k] = (T)rotation[k * row] * from[0] + (T)rotation[k * row + column] * from[1] + (T)rotation[k * row + 2 * column] * from[2];
}

// One component of a node, from what it was before the step.
struct Placed { double x, v, carried, drift; };
ANYWHERE Placed placed(double x, double v, double ahead, double carried, double gain, double reach, double beta) {
    const double after = v + gain;
    return {x + reach * (ahead + gain), after, carried - gain, beta * after / (reach + beta)};
}

// Of a node, a its own block of A: square of K x / reach, as large as the diagonal tells. Times the square of EPSILON, summed over
// the nodes, it is that of the rounding of b.
template <class A, class X>
ANYWHERE double pull_square(const A* a, const X* x, double mass, double reach) {
    const double stiff = ((double)a[0] + a[4] + a[8]) / 3 - mass;
    return stiff > 0 ? stiff * stiff * ((double)x[0] * x[0] + (double)x[1] * x[1] + (double)x[2] * x[2]) / (reach * reach) : 0;
}

// At the first linearization: |b|, its rounding, the preconditioner asked for.
ANYWHERE void start_search(Search& s, double norm, double floor, int kind) {
    s = Search{};
    s.first = s.norm = norm;
    s.floor = floor;
    s.kind = kind;
}

// What a solve of the linear system has come to.
ANYWHERE void note_solve(Search& s, double residual, double seconds, int iterations, int fallbacks, int kind, int status) {
    if (residual > s.residual) s.residual = residual;
    s.seconds += seconds;
    s.iterations += iterations;
    s.fallbacks += fallbacks;
    s.kind = kind;
    s.verdict = status == NOT_FINITE && s.linearizations == 0 ? LOST : NONE_YET;
    if (status != CONVERGED) s.status = status;
    if (status == NOT_FINITE) s.phase = DONE;
}

// Along a new way; slope: way . A way, norm: |A way|, which is b where the way begins but for the residual of the solve.
ANYWHERE void set_out(Search& s, double slope, double norm) {
    s.slope = slope;
    s.last = norm;
    ++s.linearizations;
    s.tried = 0;
    s.scale = 1;
    s.phase = TRY;
}

// What becomes of a trial at which |b| is `norm` and way . b `slope`. Sets the phase, and the scale of the next trial.
ANYWHERE int judge_trial(Search& s, const Limits& most, double norm, double slope) {
    const double goal = most.tolerance * s.first;
    const double change = slope < 0 ? -slope : slope, before = s.slope < 0 ? -s.slope : s.slope;
    s.norm = norm;
    const bool small = norm <= (s.floor > goal ? s.floor : goal);
    const bool good = is_number(norm) && (small || change <= SLACK * before || norm < s.last);
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

// A component of the gain after a verdict. Where there is no state but the first it is no number, and nor is y: the kernel `advance`
// takes the body back, as after one linearization (backends/cpu/native/pcg.h).
ANYWHERE double gain_after(const Search& s, double gain, double way) {
    if (s.verdict == LOST && s.linearizations <= 1) return 0 * s.norm;  // |b| is infinite or no number
    return s.verdict == TAKEN ? gain + s.scale * way : gain;
}

ANYWHERE double remaining(const Search& s) { return s.first > 0 ? s.norm / s.first : 0; }
