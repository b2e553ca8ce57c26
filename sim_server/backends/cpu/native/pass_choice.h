// SPDX-License-Identifier: MIT
// Which preconditioner a pass of contact begins with, for a body with a factor, or an island with some: factors or block Jacobi. A factor that does not know the
// contacts, or knows some that are gone, needs many iterations, each of which costs several of block Jacobi; a slender or stiff body
// needs hundreds of those. So both are measured, in passes: what a decade of the residual takes. The one in use goes over to the
// other within a pass that takes GIVE_UP times as much as is expected of the other one. The other one is tried now and then by a pass
// that begins with it, and goes back once it has taken as much as is expected of the one in use.
//
// Costs are counted, in bytes of A and of the factor, not measured by a clock, so that runs repeat exactly.
#pragma once
#include <algorithm>
#include <cmath>

#include "pcg.h"

constexpr int PATIENT = 20;            // iterations with a factor, where nothing is known of block Jacobi
constexpr int MIN_WAIT = 4, MAX_WAIT = 256;  // passes between trials
constexpr int MOST_WAIT_OF_NEW = 32;   // likewise, of a factor that has not been tried
constexpr double FACTOR_BYTES = 2;     // what a byte of a factor costs, read in a chain of triangular solves, where one of A is 1
constexpr double LASTS = 8;            // passes over which the cost of a correction is spread
constexpr double GIVE_UP = 1.5;        // times what is expected of the other one, at which a pass goes over to it
constexpr double CHEAPER = 0.9;        // of the cost of the one in use: the other one takes its place
constexpr double HARDER_PASS = 2;      // cost over `reference` at which the other one is tried at once
constexpr double LEAST_TRIED[2] = {2, 8};  // iterations that the cost of a pass has to be worth, of the one to be tried

struct ChoiceOfPass {
    PassChoice& choice;
    double cost[2] = {0, 0};  // of an iteration, of the factor and of block Jacobi [bytes]
    int64_t factor_step = -1; // of the newest factor
    double decades = 0;       // that the pass is to reach
    bool trial = false;       // the pass tries the other one

    explicit ChoiceOfPass(PassChoice& choice) : choice(choice) {}

    // Counts a body in. factor: null: it has block Jacobi whatever is chosen.
    void add(const BlockCsr& A, const Factor* factor) {
        const double own = 76.0 * (A.row_start[A.last] - A.row_start[A.first]);
        cost[0] += own;
        cost[1] += own;
        if (!factor) return;
        const Pattern& p = *factor->pattern;
        const int last = p.supernodes - 1;
        const int64_t n = p.super_start[last + 1] - p.super_start[last], h = p.row_start[last + 1] - p.row_start[last];
        const int64_t values = p.value_start[last] + h * n - n * (n - 1) / 2;
        cost[0] += 2 * FACTOR_BYTES * ((double)values * factor->bytes + 4.0 * p.row_start[last + 1]);
        factor_step = std::max(factor_step, factor->step);
    }

    double expected(int which) const { return choice.rate[which] * decades * cost[which]; }

    // Sets which preconditioner a pass begins with, and after how many iterations it goes over to the other one.
    void begin(SolveSettings& s) {
        const int used = choice.jacobi, other = 1 - used;
        decades = std::min(-std::log10(s.tolerance), 16.0);
        trial = wants_trial();
        const int first = trial ? other : used;
        s.kind = first ? BLOCK_JACOBI : CHOLESKY;
        s.probe = used ? 0 : PATIENT;
        if (trial) s.probe = limit(expected(used) / cost[other]);
        else if (choice.rate[other] > 0) s.probe = limit(GIVE_UP * expected(other) / cost[used]);
    }
    static int limit(double iterations) { return (int)std::min(std::max(std::ceil(iterations), 1.0), 1e9); }

    bool wants_trial() {
        const int used = choice.jacobi, other = 1 - used;
        ++choice.waited;
        const double own = expected(used);
        if (own < LEAST_TRIED[other] * cost[other]) return false;
        const bool renewed = other == 0 && choice.factor_step != factor_step;
        if (choice.rate[other] == 0 || choice.waited >= (renewed ? std::min(choice.wait, MOST_WAIT_OF_NEW) : choice.wait)) return true;
        return own > HARDER_PASS * choice.reference * decades && choice.reference > 0;
    }

    // Takes note of a pass. r: of its solve, `settings`: those it had.
    // spent: on the factor's correction, which lasts for more than a pass: a part is taken off [bytes]
    void end(const SolveSettings& settings, const SolveResult& r, double& spent) {
        const int first = settings.kind == BLOCK_JACOBI, second = 1 - first;
        if (r.status == BUDGET || r.status == NOT_FINITE || r.iterations == 0) return;
        const bool over = r.switched_after > 0;
        const double charged = first && !over ? 0 : spent / LASTS, extra[2] = {charged / cost[0], 0};
        spent -= charged;
        note(first, (over ? r.switched_after : r.iterations) + extra[first], 1, over ? r.residual_then : r.residual);
        if (over) note(second, r.iterations - r.switched_after + extra[second], r.residual_then, r.residual);
        const int used = choice.jacobi, other = 1 - used;
        const bool known = choice.rate[used] > 0 && choice.rate[other] > 0;
        const bool better = known && choice.rate[other] * cost[other] < CHEAPER * choice.rate[used] * cost[used];
        if (trial) {
            choice.wait = better ? MIN_WAIT : std::min(2 * std::max(choice.wait, MIN_WAIT / 2), MAX_WAIT);
            choice.waited = 0;
            choice.factor_step = factor_step;
            choice.reference = choice.rate[used] * cost[used];
        }
        if (better || r.fallbacks) {
            choice.jacobi = r.fallbacks ? 1 : other;
            choice.waited = 0;
            choice.reference = choice.rate[choice.jacobi] * cost[choice.jacobi];
        }
    }

    void note(int which, double iterations, double from, double to) {
        const double reached = std::log10(from / to);
        const double rate = reached > 1e-2 ? iterations / reached : 100.0 * iterations;
        if (iterations > 0 && std::isfinite(rate)) choice.rate[which] = rate;
    }
};
