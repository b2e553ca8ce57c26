// SPDX-License-Identifier: MIT
// Energy of each body after a step, and whether it has run away (criterion: kernels/energy_balance.cuh). One pass over the nodes;
// the elastic energy takes one over the elements and is evaluated on demand only.
#pragma once
#include <cstring>

#include "loop.h"
#include "start_of_balance.h"

// Sums over a body's nodes. keeps: what pushes and grabs exert stays, for another call.
static Sums sums_of(const Loop& loop, const Body& body, bool keeps = false) {
    Energies& e = *loop.energies;
    Sums s = no_sums();
    for (int i = body.first; i < body.last; ++i) {
        const double *x = loop.x + 3 * i, *v = loop.v + 3 * i, *from = e.before + 3 * i;
        const double step[3] = {x[0] - from[0], x[1] - from[1], x[2] - from[2]};
        add_node(s, e.mass[i], x, v, step, e.gravity);
        if (e.load) s.work += dot3(e.load + 3 * i, step);
        if (!e.force) continue;
        double *force = e.force + 3 * i, *anchor = e.anchor + 3 * i, &spring = e.spring[i];
        if (spring == 0 && force[0] == 0 && force[1] == 0 && force[2] == 0) continue;
        s.work += work_on(force, spring, anchor, from, step);
        if (keeps) continue;
        force[0] = force[1] = force[2] = spring = 0;  // until something touches the node again
    }
    if (loop.contact) s.work += loop.contact->report[&body - loop.body].work;
    return s;
}

static void measure_elastic(Loop& loop) {
    Energies& e = *loop.energies;
    for (int i = 0; i < loop.bodies; ++i) e.balance[i].elastic = 0;
    for (int k = 0; k < e.elastics; ++k) {
        const Elastic& elastic = e.elastic[k];
        run(elastic.launch, loop.threads);
        for (int i = 0; i < loop.bodies; ++i)
            for (int j = elastic.parts[i]; j < elastic.parts[i + 1]; ++j) e.balance[i].elastic += elastic.energy[j];
    }
}

// True if the body's positions or velocities were set since the loop was left.
static bool was_set(const Loop& loop, const Body& body) {
    const int64_t at = 3 * (int64_t)body.first, bytes = sizeof(double) * 3 * (int64_t)(body.last - body.first);
    const double* left = loop.energies->left;
    return std::memcmp(left + at, loop.x + at, bytes) || std::memcmp(left + 3 * (int64_t)loop.nodes + at, loop.v + at, bytes);
}

static void begin_balance(const Loop& loop, const Body& body, Balance& balance) {
    const Energies& e = *loop.energies;
    begin_balance(balance, body.first, body.last, e.mass, loop.x, loop.v, e.gravity, loop.rings.dt, e.inertia);
}

// Begins the balance of bodies before the first step, and of those whose state was set.
static void enter(Loop& loop) {
    Energies& e = *loop.energies;
    bool measured = false;
    for (int i = 0; i < loop.bodies; ++i) {
        if (e.begun && !was_set(loop, loop.body[i])) continue;
        if (!measured) measure_elastic(loop);
        measured = true;
        begin_balance(loop, loop.body[i], e.balance[i]);
    }
    e.begun = 1;
}

static void leave(const Loop& loop) {
    const int64_t n = 3 * (int64_t)loop.nodes;
    std::memcpy(loop.energies->left, loop.x, sizeof(double) * n);
    std::memcpy(loop.energies->left + n, loop.v, sizeof(double) * n);
}

// Sets the body back to the start of the step and fixes all its nodes.
static void freeze(const Loop& loop, const Body& body) {
    const Energies& e = *loop.energies;
    const int64_t at = 3 * (int64_t)body.first, n = 3 * (int64_t)(body.last - body.first);
    std::memcpy(loop.x + at, e.before + at, sizeof(double) * n);
    for (int k = 0; k < e.stills; ++k) std::memset(e.still[k] + at, 0, sizeof(double) * n);
    for (int i = body.first; i < body.last; ++i) e.free[i] = 0;
}

// Updates all balances after a step. elastic: evaluate the elastic energy, too.
static void account(Loop& loop, bool elastic) {
    Energies& e = *loop.energies;
    Team::each(loop.threads, loop.bodies, [&](int i) {
        Balance& b = e.balance[i];
        const double limit = b.limit;
        if (loop.halving && loop.halving->made[i]) b.limit = INFINITY;  // short steps make it up
        const bool frozen = update_balance(b, sums_of(loop, loop.body[i]), e.on_runaway, e.inertia);
        b.limit = limit;
        if (frozen) freeze(loop, loop.body[i]);
    });
    if (elastic) measure_elastic(loop);
    for (int i = 0; i < loop.bodies; ++i)
        if (!elastic || e.balance[i].found) e.balance[i].elastic = NAN;
}
