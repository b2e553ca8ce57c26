// SPDX-License-Identifier: MIT
// Newton-Raphson within a step, for each body by itself (sim_server/integrator.py has the equations). What a body's velocity
// gains in the step is searched for: gain (nodes, 3), from which all of the state follows,
//     v = v0 + gain,   x = x0 + reach (ahead0 + gain),   ahead = 0,   carried = carried0 - gain,
// so that what the launches assemble at a trial is the nonlinear residual b there and the matrix A of the next linearization.
//   - A linearization gives a way, tried whole at first. It is taken if |way . b| <= 0.9 of what that was at its beginning
//     (the line search of Matthies and Strang 1979, IJNME 14) or if |b| has fallen; else a part of it is tried: up to where
//     the secant of way . b has its zero, at least a tenth and at most a half. A tighter search takes longer: in a slender
//     body what minimizes along a straight way is a short step.
//   - The first way begins at the state before the step, gain = -ahead0, and its first trial is what one linearization gives.
//   - The search is over when |b| <= tolerance |b of the step's first linearization|, or when b is rounding.
#pragma once
#include <algorithm>

#include "loop.h"

constexpr double SLACK = 0.9;

struct Room {  // parts of a body's share of Newton::room, (3 n,) each
    int n;
    double *x, *v, *ahead, *carried, *gain, *way;
    Room(const Newton& newton, const Body& body) : n(3 * (body.last - body.first)) {
        x = newton.room + 18 * (int64_t)body.first;
        v = x + n; ahead = v + n; carried = ahead + n; gain = carried + n; way = gain + n;
    }
};

static double norm(int n, const double* a) { return std::sqrt(dot(n, a, a)); }

// Rounding of b: that of K x / reach, as large as the diagonal of A tells.
static double rounding(const Loop& loop, const Body& body) {
    const Newton& newton = *loop.newton;
    double sum = 0;
    for (int i = body.first; i < body.last; ++i) {
        int k = loop.row_start[i], end = loop.row_start[i + 1];
        if (end - k < 2) continue;  // fixed
        while (loop.columns[k] != i) ++k;
        const double *a = loop.values + 9 * (int64_t)k, *x = loop.x + 3 * i;
        double stiff = std::fmax(0, (a[0] + a[4] + a[8]) / 3 - newton.mass[i]) / newton.reach;
        sum += stiff * stiff * dot(3, x, x);
    }
    return 2.2e-16 * std::sqrt(sum);
}

static void begin_search(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    Room room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    for (int k = 0; k < room.n; ++k) {
        room.x[k] = loop.x[at + k];
        room.v[k] = loop.v[at + k];
        room.ahead[k] = newton.ahead[at + k];
        room.carried[k] = newton.carried[at + k];
        room.gain[k] = -room.ahead[k];
    }
    Search& search = newton.search[index];
    search = Search{};
    search.first = search.norm = norm(room.n, loop.b + at);
    search.floor = rounding(loop, body);
    search.kind = body.settings.kind;
}

// The state after gain + scale * way.
static void place(Loop& loop, const Body& body, double scale) {
    const Newton& newton = *loop.newton;
    Room room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    for (int k = 0; k < room.n; ++k) {
        double gain = room.gain[k] + scale * room.way[k], beta = newton.beta[body.first + k / 3];
        loop.x[at + k] = room.x[k] + newton.reach * (room.ahead[k] + gain);
        loop.v[at + k] = room.v[k] + gain;
        newton.ahead[at + k] = 0;
        newton.carried[at + k] = room.carried[k] - gain;
        newton.drift[at + k] = beta * loop.v[at + k] / (newton.reach + beta);
    }
}

// to = R from, or R^T from
static void turn(const Newton& newton, const Body& body, bool back, const double* from, double* to) {
    for (int i = 0; i < body.last - body.first; ++i) {
        const double *R = newton.rotation + 9 * (int64_t)(body.first + i), *f = from + 3 * i;
        double* t = to + 3 * i;
        const int row = back ? 1 : 3, column = back ? 3 : 1;
        for (int k = 0; k < 3; ++k) t[k] = R[k * row] * f[0] + R[k * row + column] * f[1] + R[k * row + 2 * column] * f[2];
    }
}

// One linearization, if it is the body's turn.
static void solve(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    Body& body = loop.body[index];
    Search& search = newton.search[index];
    if (search.phase != SOLVE) return;
    Room room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    double *y = loop.y + at, *work = loop.work + 45 * (int64_t)body.first, *turned = work, *product = work + room.n;
    BlockCsr A{body.first, body.last, loop.row_start, loop.columns, loop.values};
    SolveSettings settings = body.settings;
    settings.warm_start = settings.warm_start && search.linearizations == 0;  // the last step's is no guess for a correction
    SolveResult r = pcg(A, loop.b + at, body.factor, settings, y, work, &body.recycled, &body.correction);
    search.residual = std::fmax(search.residual, r.residual);
    search.seconds += r.seconds;
    search.iterations += r.iterations;
    search.fallbacks += r.fallbacks;
    search.kind = r.kind;
    if (r.status != CONVERGED) search.status = r.status;
    if (r.status == NOT_FINITE) {  // back, as after one linearization (pcg.h)
        if (search.linearizations == 0) std::fill(room.gain, room.gain + room.n, NAN);
        search.phase = DONE;
        return;
    }
    turn(newton, body, false, y, room.way);
    if (search.linearizations == 0)
        for (int k = 0; k < room.n; ++k) room.way[k] += room.ahead[k];
    turn(newton, body, true, room.way, turned);
    search.slope = multiply(A, turned, product);  // b where the way begins is A way, but for the residual of the solve
    search.last = norm(room.n, product);
    ++search.linearizations;
    search.tried = 0;
    search.scale = 1;
    search.phase = TRY;
    place(loop, body, 1);
}

// What becomes of a trial: taken, made shorter, or the end.
static int judge(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    Search& search = newton.search[index];
    if (search.phase != TRY) return search.phase;
    Room room(newton, body);
    const double* b = loop.b + 3 * (int64_t)body.first;
    double* turned = loop.work + 45 * (int64_t)body.first;
    turn(newton, body, true, room.way, turned);
    search.norm = norm(room.n, b);
    bool small = search.norm <= std::fmax(newton.tolerance * search.first, search.floor);
    double slope = dot(room.n, turned, b);
    bool good = small || std::fabs(slope) <= SLACK * std::fabs(search.slope) || search.norm < search.last;
    if (!std::isfinite(search.norm)) good = false;
    if (!good && search.tried < newton.trials) {
        ++search.tried;
        double root = search.slope / (search.slope - slope);
        search.scale *= root > 0 ? std::fmin(0.5, std::fmax(0.1, root)) : 0.5;  // also NaN
        place(loop, body, search.scale);
        return search.phase;
    }
    if (!std::isfinite(search.norm)) {  // nothing on this way is a state
        if (search.linearizations == 1) std::fill(room.gain, room.gain + room.n, NAN);  // as of pcg
        search.status = NOT_FINITE;
        return search.phase = DONE;
    }
    for (int k = 0; k < room.n; ++k) room.gain[k] += search.scale * room.way[k];
    if (small) return search.phase = DONE;
    if (search.linearizations < newton.linearizations) return search.phase = SOLVE;
    if (search.status == CONVERGED) search.status = MAX_LINEARIZATIONS;
    return search.phase = DONE;
}

// The state before the step again, and y so that `advance` makes of it what was found.
static void end_search(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    const Body& body = loop.body[index];
    Room room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    for (int k = 0; k < room.n; ++k) {
        loop.x[at + k] = room.x[k];
        loop.v[at + k] = room.v[k];
        newton.ahead[at + k] = room.ahead[k];
        newton.carried[at + k] = room.carried[k];
    }
    turn(newton, body, true, room.gain, loop.y + at);
}

// As of one solve.
static SolveResult found(const Search& search) {
    return SolveResult{search.residual, search.seconds, search.iterations, search.status, search.kind, search.fallbacks};
}

static double remaining(const Search& search) { return search.first > 0 ? search.norm / search.first : 0; }
