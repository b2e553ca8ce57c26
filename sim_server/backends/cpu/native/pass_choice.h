// SPDX-License-Identifier: MIT
// The choice of a preconditioner for a pass of contact on a CPU (kernels/pass_choice.cuh): costs are counted in bytes of A and of the factor.
#pragma once
#include <algorithm>

#include "pass_choice.cuh"
#include "pcg.h"

constexpr double FACTOR_BYTES = 2;     // what a byte of a factor costs, read in a chain of triangular solves, where one of A is 1
constexpr double LASTS = 8;            // passes over which the cost of a correction is spread

struct ChoiceOfPass {
    PassChoice& choice;
    PassBegin pass = {{0, 0}, 0, -1, 0, 0, 0};  // factor_step -1: there is no factor

    explicit ChoiceOfPass(PassChoice& choice) : choice(choice) {}

    // Counts a body in. factor: null: it has block Jacobi whatever is chosen.
    void add(const BlockCsr& A, const Factor* factor) {
        const double own = 76.0 * (A.row_start[A.last] - A.row_start[A.first]);
        pass.cost[0] += own;
        pass.cost[1] += own;
        if (!factor) return;
        const Pattern& p = *factor->pattern;
        const int last = p.supernodes - 1;
        const int64_t n = p.super_start[last + 1] - p.super_start[last], h = p.row_start[last + 1] - p.row_start[last];
        const int64_t values = p.value_start[last] + h * n - n * (n - 1) / 2;
        pass.cost[0] += 2 * FACTOR_BYTES * ((double)values * factor->bytes + 4.0 * p.row_start[last + 1]);
        pass.factor_step = std::max(pass.factor_step, (long long)factor->step);
    }

    // end: relative residual at which the solve is to end
    void begin(SolveSettings& s, double end) {
        begin_pass(choice, pass, end);
        s.kind = pass.first ? BLOCK_JACOBI : CHOLESKY;
        s.probe = pass.probe;
    }

    // spent: on the factor's correction, which lasts for more than a pass: a part is taken off [bytes]
    void end(const SolveResult& r, double& spent) {
        if (r.status == BUDGET || r.status == NOT_FINITE || r.iterations == 0) return;
        const double charged = pass.first && !(r.switched_after > 0) ? 0 : spent / LASTS;
        spent -= charged;
        end_pass(choice, pass, {r.iterations, r.switched_after, r.fallbacks, r.residual, r.residual_then}, charged / pass.cost[0]);
    }
};
