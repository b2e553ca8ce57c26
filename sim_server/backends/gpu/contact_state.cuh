// SPDX-License-Identifier: MIT
// Contact on a GPU: the state of a body in a step, and what the solver (pcg.cu) does for a pass. The graph of a step is
//
//     assembly and detection, begin_contact, contact_forces, pcg, contact_search,
//     while a body is not OVER (conditions.py): contact_forces, pcg, contact_search
//     finish_contact, integration
//
// Each body goes its own way (method: backends/cpu/native/contact.h): CHOOSE_START or WITHOUT and what follows from it, then READY and
// PASSED, LAST_PASSED or ENDED once per pass, and OVER. A row acts on the block of one node only, so contact_forces adds its stiffness to the values of A. With
//     K = A + H^T S H,   b' = b + i H^T f + H^T S H y
// a pass is K y' = b', solved from y: the first residual that the solver finds is that of the step with the law.
#pragma once
#include "contact_passes.cuh"
#include "pcg_structs.cuh"

enum ContactPhase {
    CHOOSE_START = 0,  // the solver looks which start is the better one
    WITHOUT = 1,       // it solves as without contact
    FROM_START = 2,    // it begins from y as it was; contact_search looks whether the law holds there
    FROM_ZERO = 3,     // or from zero
    SOLVED = 4,        // it has solved as without contact; contact_search looks whether anything is touched
    READY = 5,         // forces and stiffness are evaluated next, then there is a pass
    PASSED = 6,        // the solver has made a pass
    LAST_PASSED = 7,   // and the last one
    ENDED = 8,         // it had nothing to solve any more, or there are no passes left
    LOST = 9,          // forces are not finite
    OVER = 10
};

struct ContactState {   // of a body
    double given2;      // square of what residuals are relative to, the larger one of |b| and |b + i H^T f|
    double zero2;       // |b + i H^T f|^2 at y = 0
    double alpha;       // part of the last solution that is taken
    double residual;    // with the law, relative; NaN: not known
    int phase, passes, rounds;
    int set;            // 1: rows with in_set count as closed
    int by_law;         // 1: the rows that count as closed are those that the law closes
    int hold;           // 1: there was a pass since limits were set
    int rows;           // number of rows that are not empty
    int rested;         // 1: the law held where the step began
};

struct ContactSolve {   // what a solve has beside PcgArguments
    ContactState* state;  // (bodies,)
    real* first;          // (nodes, 3) residual before the pass
    real* last;           // (nodes, 3) and after it; -A y in the first solve of a step
    double tolerance;     // of the contact residual
    int passes, first_of_step;
};

// What becomes of a body that is READY. r2: square of the residual before the pass. goal2: of that which the last pass is to reach.
HOST_DEVICE int outcome_of(const ContactState& c, const ContactSolve& pass, double r2, double goal2) {
    const bool last = c.by_law && r2 <= pass.tolerance * pass.tolerance * c.given2;
    if (last) return r2 <= goal2 ? ENDED : LAST_PASSED;
    return c.passes >= pass.passes ? ENDED : PASSED;
}

// Square of the residual to which a pass is solved that need not be the last one.
HOST_DEVICE double early_goal(const ContactState& c, const ContactSolve& pass, double r2, double goal2) {
    const double early = early_tolerance(sqrt(r2 / c.given2), pass.tolerance, c.passes, pass.passes);
    return early * early * r2 > goal2 ? early * early * r2 : goal2;
}

// Adds a solve to a body's state and to the result of its step.
HOST_DEVICE void note_pass(ContactState& c, const ContactSolve& pass, int outcome, PcgResult& sum, const PcgResult& out) {
    c.phase = out.status == NOT_FINITE ? LOST : outcome;
    if (c.phase == ENDED) {
        c.residual = out.residual;
        if (c.by_law && out.residual <= pass.tolerance) sum.residual = out.residual;
        return;
    }
    if (pass.first_of_step) {
        sum = out;
        return;
    }
    ++c.passes;
    sum.seconds += out.seconds;
    sum.iterations += out.iterations;
    sum.fallbacks += out.fallbacks;
    sum.kind = out.kind;
    sum.status = out.status;
    sum.bad_node = out.bad_node;
    sum.residual = out.residual;
    sum.at_rest = out.at_rest;
#ifdef ERRORS
    sum.solve_error = out.solve_error;
#endif
    if (out.factor_step >= 0) sum.factor_step = out.factor_step;
}
