// SPDX-License-Identifier: MIT
// Budgets of wall time on a GPU (-DBUDGETS): of a step, and of a solve. Rules are those of the CPU (backends/cpu/native/pcg.h, newton.h), with
// times that the device measures by its own clock. Bodies are solved at once, so that each has the whole budget.
#pragma once
#include "newton_line_search.cuh"
#include "pcg_structs.cuh"

// Time at which a solve ends [ns], 0: none. begun: of the step. reserve: what follows within the step [s].
HOST_DEVICE long long deadline_of(const PcgBody& body, long long begun, double reserve) {
    return body.step_budget > 0 ? begun + (long long)(1e9 * (body.step_budget - reserve)) : 0;
}

// Whether a solve that began at `start` has spent its time, where another iteration and what ends the solve, its true residual, take
// as long as an iteration each. iteration: of the last one. All in ns.
HOST_DEVICE bool is_spent(const PcgBody& body, long long start, long long deadline, long long now, long long iteration) {
    const long long end = now + 2 * iteration;
    return (deadline != 0 && end > deadline) || (body.budget > 0 && 1e-9 * (end - start) > body.budget);
}

// Whether a solve ends after so many iterations. In a replay the budget is -1 - those of the step.
HOST_DEVICE bool ends_by_budget(const PcgBody& body, bool spent, int iterations, bool first) {
    return body.budget < 0 ? iterations + 1 == -body.budget && (first || iterations > 0) : spent && iterations > 0;
}

// The budget of the next solve of a step with so many iterations.
HOST_DEVICE double budget_left(double budget, int iterations) {
    return budget >= 0 ? budget : budget + iterations < -1 ? budget + iterations : -1;
}

// From a solve to the end of the step: forces of its trial, and blocks and a product for its estimate [s].
HOST_DEVICE double seconds_after_solve(const TrialClock& c) { return c.forces + c.blocks + c.judging; }

// Of another linearization, to its estimate [s]: of a solve that is as long as those before, or has three iterations.
HOST_DEVICE double seconds_of_another(const Search& s, const TrialClock& c) {
    const double usual = s.seconds / s.linearizations, few = 3 * s.seconds / (s.iterations > 1 ? s.iterations : 1);
    return c.blocks + (usual < few ? usual : few) + seconds_after_solve(c);
}

// After a trial was evaluated: where the budget does not allow another linearization, or did not in the run that is replayed, the state
// is that of the step, and the next solve tells its error.
HOST_DEVICE void end_by_budget(Search& s, const PcgBody& body, const TrialClock& c, long long begun, long long now) {
    if (s.verdict != TAKEN) return;
    const double left = body.step_budget - 1e-9 * (now - begun);
    const bool spent = body.step_budget > 0 && s.phase == SOLVE && seconds_of_another(s, c) > left;
    const bool was_spent = body.most_linearizations > 0 && s.phase != SOLVE;
    if (spent || was_spent) s.phase = SPENT;
}
