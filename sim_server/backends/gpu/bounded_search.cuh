// SPDX-License-Identifier: MIT
// Newton-Raphson with a bound of the error of positions on a GPU (decisions: kernels/newton_line_search.cuh): what the solver (pcg.cu) decides
// of a search (newton.cu). A trial that was taken is judged by the first z = P^-1 b of the next solve.
#pragma once
#include "newton_line_search.cuh"
#include "pcg_structs.cuh"

// Relative tolerance with which a solve begins. That of a later linearization is set when z is known.
HOST_DEVICE double first_tolerance(const Search& s, const PcgBody& body) {
    return s.linearizations == 0 ? solve_tolerance(s, body.tolerance, body.plan ? body.kind : BLOCK_JACOBI) : body.tolerance;
}

// Whether a search that has ended awaits the estimate of its error.
HOST_DEVICE bool is_awaited(int phase) { return phase == LAST || phase == SPENT; }

// Judges the last trial by z = P^-1 b of `kind`, |z| = size, in the solve of a later linearization. Returns whether the search ends; else the
// forcing term is that of the solve.
HOST_DEVICE bool ends_by_start(Search& s, const PcgBody& settings, int kind, double size) {
    if (kind != s.kind) s.factor_scale = 0;
    const double estimate = state_error(s, size, settings.dx_dv);
    if (settings.position > 0) {
        s.applied = kind == CHOLESKY && kind == s.kind;
        bound_error(s, estimate, settings.trust, settings.position);
    } else {
        s.step_error = estimate;
    }
    if (s.phase == SPENT) s.status = BUDGET;
    return s.phase != SOLVE;
}

// Whether z that has ended a search is added to the solution.
HOST_DEVICE bool is_added(const Search& s, const PcgBody& settings) { return s.phase == DONE && adds_remaining(s, settings.trust); }

// Of a solve that began with z. solution, z: largest of a node; difference: of both; solve_error: of the solution [m], 0: not known.
HOST_DEVICE void note_left(Search& s, double solution, double difference, double z, double solve_error, double dx_dv) {
    s.moved = dx_dv * solution;
    s.left = solve_error > 0 && z > 0 ? (difference + solve_error / dx_dv) / z : 0;
}

// After a solve: whether the search is over, since its start was exact enough, or nothing was to be estimated.
HOST_DEVICE bool is_over(const Search& s, const PcgResult& r, bool bounded) {
    return s.phase == DONE || is_awaited(s.phase) || (bounded && s.linearizations > 0 && r.iterations == 0 && r.status == CONVERGED);
}

// A member of a result in which 0 is not known.
HOST_DEVICE double as_known(double error) { return error > 0 ? error : not_known(); }
HOST_DEVICE double as_told(double error) { return error > 0 ? error : 0; }
