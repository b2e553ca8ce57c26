// SPDX-License-Identifier: MIT
// The Rosenbrock-W step on a GPU (method: mechanics/rosenbrock.py): state of the bodies, and the decision about an attempt.
//
// The graph of a step holds one attempt of all bodies. What only some steps need hangs on conditional nodes (conditions.py):
//
//     solve by the factor      forces, apply_factor, second, forces, apply_factor, finish, [ITERATE: restore, assembly, pcg, second,
//                              forces, pcg, finish, [EULER: restore_for_euler, assembly, pcg, euler]]
//     solve by iterations      assembly, pcg, second, forces, pcg, finish, [EULER]
//
// Where a body has no fixed nodes one more launch ends the step, after the branches: momentum.cu.
// In the first attempt by the factor the bodies that have to iterate do nothing of use; in the branches only bodies whose step is
// not made yet take part.
#pragma once
#include "pcg_structs.cuh"
#include "step_form.h"

enum StepPhase { OPEN = 0, MADE = 2 };  // of a body in a step; MADE is DONE of newton_line_search.cuh, see kernel_fusion.PhaseGuard

struct StageState {          // of a body
    int form;                // StepForm of its attempt
    int patience;            // steps to come that iterate
    int springs;             // 1: a grab pulls at it by a spring in this step, or elements were removed
    int unused;
    long long factor_step;   // of the factor of the last step, -1: none
    long long spring_step;   // last step with such a spring or cut, -1: none
    double estimate;         // of the last attempt [m]
    double inconsistency;    // of its first stage, |y . (b - A y)| / |y . b|, if by the factor
};

struct StageSolve {          // what the solves of an attempt have beside PcgArguments
    StageState* state;       // (bodies,)
    const int* phase;        // (bodies,) StepPhase
    const real* spring;      // (nodes,) of grabs [N/m]; null: nothing can be touched
    const double* changed_at; // (nodes,) when the node last lost or got back an element [s]; null: none does
    const double* clock;     // (1,) [s]
    const real* mass;        // (nodes,) [kg]
    const real* share;       // (nodes,) theta of mechanics/rosenbrock.py
    const real* weight;      // (nodes,) w likewise
    real* first_stage;       // (3, nodes, 3) of the first application: start of the solve, b, y
    int form;                // of the attempt; apply_factor: FACTOR
    int first_of_step;       // 1: the first solve of the step
    int first_of_attempt;
};

#ifdef __CUDACC__
#define DECIDES __device__ __forceinline__
#else
#define DECIDES inline
#endif

// Step of the matrix of the body's factor, -1: it has none.
DECIDES long long factor_step_of(const PcgBody& body) { return body.plan ? body.factor_step : -1; }

// Whether the factor may stand in for A in this step. It does not know the springs of grabs that were there when it was made and
// have gone, nor those that have come, nor cuts since.
DECIDES bool may_use_factor(const StageState& s, const PcgBody& body) {
    const long long step = factor_step_of(body);
    return step >= 0 && body.kind == CHOLESKY && step > s.spring_step && (s.patience == 0 || s.factor_step != step);
}

// Result of a step before its first solve; a body at rest has none.
DECIDES PcgResult no_solve(const PcgBody& body) {
    return {0, 0, body.kind == CHOLESKY ? factor_step_of(body) : -1, 0, CONVERGED, body.kind, body.kind, 0, -1, body.probe, 1};
}

// Adds a solve to the result of the step.
DECIDES void add_solve(PcgResult& sum, const PcgResult& r) {
    sum.seconds += r.seconds;
    sum.iterations += r.iterations;
    sum.fallbacks += r.fallbacks;
    sum.kind = r.kind;
    sum.at_rest = r.at_rest;
    if (!(r.residual <= sum.residual)) sum.residual = r.residual;
    if (r.factor_step >= 0) sum.factor_step = r.factor_step;
#ifdef ERRORS
    sum.solve_error += r.solve_error;
#endif
    if (r.status == CONVERGED) return;
    sum.status = r.status;
    sum.bad_node = r.bad_node;
}

// Judges the attempt of a body in the form `attempt`; true: it is the step, else s.form is that of the next attempt. In the first
// attempt by the factor a body with s.form ITERATE has not taken part. step: steps completed before.
DECIDES bool judge(StageState& s, const PcgBody& body, int attempt, double estimate, double bound, bool moving, long long step) {
    if (attempt == EULER) return true;
    const bool iterates = s.form == ITERATE, well = estimate <= bound;  // not if NaN
    if (attempt == FACTOR) {
        if (s.factor_step != factor_step_of(body)) s.patience = 0;
        s.factor_step = factor_step_of(body);
        if (s.patience > 0) --s.patience;
        if (s.springs) s.spring_step = step;
        s.springs = 0;
        if (!moving) { s.estimate = 0; return true; }
        if (!iterates) s.estimate = estimate;
        if (!iterates && well && s.inconsistency <= INCONSISTENT) return true;
        if (!iterates) s.patience = PATIENCE;
        s.form = ITERATE;
        return false;
    }
    s.estimate = estimate;
    if (well) return true;
    s.form = EULER;
    if (s.patience < 1) s.patience = 1;
    return false;
}
