// SPDX-License-Identifier: MIT
// Which preconditioner a pass of contact begins with, for a body with a factor, or an island with some: factors or block Jacobi. A factor
// that does not know the contacts, or knows some that are gone, needs many iterations, each of which costs several of block Jacobi; a
// slender or stiff body needs hundreds of those. So both are measured, in passes: what a decade of the residual takes. The one in use
// goes over to the other within a pass that takes GIVE_UP times as much as is expected of the other one. The other one is tried now and
// then by a pass that begins with it, and goes back once it has taken as much as is expected of the one in use.
//
// Costs are counted, not measured by a clock, so that runs repeat exactly.
#pragma once
#include "host_device.cuh"
#ifndef __CUDACC__
#include <cmath>
#endif

constexpr int PATIENT = 20;            // iterations with a factor, where nothing is known of block Jacobi
constexpr int MIN_WAIT = 4, MAX_WAIT = 256;  // passes between trials
constexpr int MOST_WAIT_OF_NEW = 32;   // likewise, of a factor that has not been tried
constexpr double GIVE_UP = 1.5;        // times what is expected of the other one, at which a pass goes over to it
constexpr double CHEAPER = 0.9;        // of the cost of the one in use: the other one takes its place
constexpr double HARDER_PASS = 2;      // cost over `reference` at which the other one is tried at once

struct PassChoice {         // of a body, kept from step to step
    double rate[2];         // iterations a decade of the residual, of the factor and of block Jacobi; 0: not known
    double reference;       // what the one in use cost when the other one was tried last, a decade
    long long factor_step;  // of the factor in use when the other one was tried last
    int jacobi;             // 1: block Jacobi is in use, 0: the factor
    int wait, waited;       // passes between trials; since the last one
};

struct PassBegin {          // of a solve
    double cost[2];         // of an iteration, of the factor and of block Jacobi
    double decades;         // that the pass is to reach
    long long factor_step;  // of the newest factor, or what else tells factors apart
    int first;              // 1: it begins with block Jacobi, 0: with the factor
    int probe;              // iterations after which it goes over to the other one; 0: it does not
    int trial;              // 1: it tries the other one
};

struct PassEnd {            // of a solve
    int iterations, switched_after, fallbacks;
    double residual, residual_then;  // relative, at the end and where it went over
};

HOST_DEVICE double expected_cost(const PassChoice& choice, const PassBegin& pass, int which) {
    return choice.rate[which] * pass.decades * pass.cost[which];
}

HOST_DEVICE int iterations_for(double cost, double of_one) {
    const double most = ceil(cost / of_one);
    return most < 1 ? 1 : most > 1e9 ? 1000000000 : (int)most;
}

HOST_DEVICE bool wants_trial(PassChoice& choice, const PassBegin& pass) {
    const int used = choice.jacobi, other = 1 - used;
    ++choice.waited;
    const double own = expected_cost(choice, pass, used), least = other ? 8 : 2;  // iterations that a pass has to be worth, of the other one
    if (own < least * pass.cost[other]) return false;
    const bool renewed = other == 0 && choice.factor_step != pass.factor_step;
    const int wait = renewed && choice.wait > MOST_WAIT_OF_NEW ? MOST_WAIT_OF_NEW : choice.wait;
    if (choice.rate[other] == 0 || choice.waited >= wait) return true;
    return own > HARDER_PASS * choice.reference * pass.decades && choice.reference > 0;
}

// Sets which preconditioner a pass begins with, and after how many iterations it goes over to the other one. tolerance: of its residual.
// pass: its cost and factor_step are set.
HOST_DEVICE void begin_pass(PassChoice& choice, PassBegin& pass, double tolerance) {
    const int used = choice.jacobi, other = 1 - used;
    pass.decades = -log10(tolerance) < 16 ? -log10(tolerance) : 16;
    pass.trial = wants_trial(choice, pass);
    pass.first = pass.trial ? other : used;
    pass.probe = used ? 0 : PATIENT;
    if (pass.trial) pass.probe = iterations_for(expected_cost(choice, pass, used), pass.cost[other]);
    else if (choice.rate[other] > 0) pass.probe = iterations_for(GIVE_UP * expected_cost(choice, pass, other), pass.cost[used]);
}

HOST_DEVICE void note_rate(PassChoice& choice, int which, double iterations, double from, double to) {
    const double reached = log10(from / to), rate = reached > 1e-2 ? iterations / reached : 100.0 * iterations;
    if (iterations > 0 && rate - rate == 0) choice.rate[which] = rate;
}

// Takes note of a pass that made iterations. extra: what its factor has cost beside, in iterations.
HOST_DEVICE void end_pass(PassChoice& choice, const PassBegin& pass, const PassEnd& end, double extra) {
    const int first = pass.first, second = 1 - first, used = choice.jacobi, other = 1 - used;
    const bool over = end.switched_after > 0;
    note_rate(choice, first, (over ? end.switched_after : end.iterations) + (first ? 0 : extra), 1, over ? end.residual_then : end.residual);
    if (over) note_rate(choice, second, end.iterations - end.switched_after + (second ? 0 : extra), end.residual_then, end.residual);
    const bool known = choice.rate[used] > 0 && choice.rate[other] > 0;
    const bool better = known && choice.rate[other] * pass.cost[other] < CHEAPER * choice.rate[used] * pass.cost[used];
    if (pass.trial) {
        const int twice = 2 * (choice.wait > MIN_WAIT / 2 ? choice.wait : MIN_WAIT / 2);
        choice.wait = better ? MIN_WAIT : twice < MAX_WAIT ? twice : MAX_WAIT;
        choice.waited = 0;
        choice.factor_step = pass.factor_step;
        choice.reference = choice.rate[used] * pass.cost[used];
    }
    if (better || end.fallbacks) {
        choice.jacobi = end.fallbacks ? 1 : other;
        choice.waited = 0;
        choice.reference = choice.rate[choice.jacobi] * pass.cost[choice.jacobi];
    }
}
