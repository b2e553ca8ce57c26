// SPDX-License-Identifier: MIT
// Newton-Raphson within a step on a CPU: what it is stands in kernels/newton_line_search.cuh.
#pragma once
#include <algorithm>

#include "loop.h"

struct Room {  // parts of a body's share of Newton::room, (3 n,) each
    int n;
    double *x, *v, *ahead, *carried, *gain, *way;
    Room(const Newton& newton, const Body& body) : n(3 * (body.last - body.first)) {
        x = newton.room + 18 * (int64_t)body.first;
        v = x + n; ahead = v + n; carried = ahead + n; gain = carried + n; way = gain + n;
    }
};

static double norm(int n, const double* a) { return std::sqrt(dot(n, a, a)); }

// Of b.
static double rounding(const Loop& loop, const Body& body) {
    const Newton& newton = *loop.newton;
    double sum = 0;
    for (int i = body.first; i < body.last; ++i) {
        int k = loop.row_start[i], end = loop.row_start[i + 1];
        if (end - k < 2) continue;  // fixed
        while (loop.columns[k] != i) ++k;
        sum += pull_square(loop.values + 9 * (int64_t)k, loop.x + 3 * i, newton.mass[i], newton.reach);
    }
    return EPSILON<double> * std::sqrt(sum);
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
    start_search(newton.search[index], norm(room.n, loop.b + at), rounding(loop, body), body.now.kind);
}

// The state after gain + scale * way.
static void place(Loop& loop, const Body& body, double scale) {
    const Newton& newton = *loop.newton;
    Room room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    for (int k = 0; k < room.n; ++k) {
        const double gain = room.gain[k] + scale * room.way[k], beta = newton.beta[body.first + k / 3];
        const Placed p = placed(room.x[k], room.v[k], room.ahead[k], room.carried[k], gain, newton.reach, beta);
        loop.x[at + k] = p.x;
        loop.v[at + k] = p.v;
        newton.ahead[at + k] = 0;
        newton.carried[at + k] = p.carried;
        newton.drift[at + k] = p.drift;
    }
}

// to = R from, or R^T from
static void turn(const Newton& newton, const Body& body, bool back, const double* from, double* to) {
    for (int i = 0; i < body.last - body.first; ++i)
        turn_node(newton.rotation + 9 * (int64_t)(body.first + i), back, from + 3 * i, to + 3 * i);
}

// One linearization, if it is the body's turn.
static void solve(Loop& loop, int index) {
    const Newton& newton = *loop.newton;
    Body& body = loop.body[index];
    Search& search = newton.search[index];
    if (search.phase != SOLVE) return;
    Room room(newton, body);
    const int64_t at = 3 * (int64_t)body.first;
    double *y = loop.y + at, *work = loop.work + 27 * (int64_t)body.first, *turned = work, *product = work + room.n;
    BlockCsr A{body.first, body.last, loop.row_start, loop.columns, loop.values};
    SolveSettings settings = body.now;
    settings.warm_start = settings.warm_start && search.linearizations == 0;  // the last step's is no guess for a correction
    SolveResult r = pcg(A, loop.b + at, body.factor, settings, y, work, !loop.moving[index], &body.correction);
    note_solve(search, r.residual, r.seconds, r.iterations, r.fallbacks, r.kind, r.status);
    if (search.phase == DONE) {
        for (int k = 0; k < room.n; ++k) room.gain[k] = gain_after(search, room.gain[k], room.way[k]);
        return;
    }
    turn(newton, body, false, y, room.way);
    if (search.linearizations == 0)
        for (int k = 0; k < room.n; ++k) room.way[k] += room.ahead[k];
    turn(newton, body, true, room.way, turned);
    const double slope = multiply(A, turned, product);
    set_out(search, slope, norm(room.n, product));
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
    double* turned = loop.work + 27 * (int64_t)body.first;
    turn(newton, body, true, room.way, turned);
    const int verdict = judge_trial(search, newton.most, norm(room.n, b), dot(room.n, turned, b));
    if (verdict == SHORTER) place(loop, body, search.scale);
    else
        for (int k = 0; k < room.n; ++k) room.gain[k] = gain_after(search, room.gain[k], room.way[k]);
    return search.phase;
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
