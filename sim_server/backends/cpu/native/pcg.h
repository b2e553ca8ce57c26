// SPDX-License-Identifier: MIT
// Preconditioned conjugate gradients for one body, numbered after Saad, Iterative Methods for Sparse Linear Systems, 2nd
// edition, algorithm 9.1. Differences from the book:
//   - a solve has converged only if its true residual, computed at the end, has |b - A x| <= tolerance |b|; if the recursive one was
//     too small the iteration restarts from the true one;
//   - it starts from the last solution if that is better than zero;
//   - for a body at rest, whose b is rounding (criterion: kernels/nodes.cu), x keeps its initial value, so that the body stands still;
//   - breakdowns p'Ap <= 0 and z'r <= 0 are detected and reported. A factor with z'r <= 0 is replaced by block Jacobi at once; so is
//     one that has not reduced the residual by a quarter of the decades required after half of max_iterations (if that is at least
//     ENOUGH): a useless factor costs iterations, but never the answer. A quarter, not half, since convergence speeds up, and an old
//     factor that still converges would be dropped. With few iterations the first ones tell nothing, and block Jacobi cannot use the
//     rest;
//   - a time budget allows at least one iteration: with none a body would miss its forces.
// With `position` it ends, too, where the estimated error is below it. That takes an iteration at least, which tells the scale of P^-1,
// unless an earlier solve of the step has.
// An iteration is one application of A after the initial residual.
#pragma once
#include "bsr.h"
#include "factor_sweeps.h"
#include "iterate_error.h"
#include "kinds.h"
#include "ring_buffers.h"
#include "woodbury.h"

constexpr double USEFUL = 1e-6;      // tolerance by which factors count as useless where `position` ends solves
constexpr double LOST_DIGITS = 1.1;  // times |r|^2 as updated, within which the true one is taken for it
constexpr int WORK = 30;    // doubles a node of a solve's memory

struct SolveSettings {
    double tolerance;       // of |b|
    double budget;          // s of wall time, 0: none; below 0: ends after -budget - 1 iterations (replays)
    int32_t max_iterations;
    int32_t kind;           // Kind wanted; CHOLESKY without a factor is BLOCK_JACOBI
    int32_t warm_start;
    int32_t probe;          // > 0: after so many iterations go from block Jacobi to the factor, or the other way
    double omega;           // of SSOR
    double position;        // largest estimated error of a node at which a solve ends [m], 0: none (error_estimate.cuh)
    double trust;           // times the estimate with a factor is at least the error
    double dx_dv;           // of the step [s]
    double step_budget;     // s of wall time from the beginning of the step, 0: none
    double deadline;        // steady clock at which it ends [s], 0: none; set by the loop
    int32_t most_linearizations;  // of the step, 0: those of the scene (replays of steps that a budget ended)
    double factor_scale;    // of P^-1, of an earlier solve of the step (SolveResult), 0: not known
    double residual_limit;  // of |b|, which the residual may not exceed where `position` ends a solve; 0: none
};

struct SolveResult {
    double residual;        // true, relative
    double seconds;
    int32_t iterations, status;
    int32_t kind;           // used at the end
    int32_t fallbacks;      // 1: the factor was left in this solve
    int32_t switched_after; // iterations before a probe went over to the other kind, 0: it did not
    double residual_then;   // recursive, relative
    double solve_error = NAN;  // estimated, of the solution, largest of a node [m]; NaN: not known
    double factor_scale = 0;   // of P^-1 at the end: the estimate over dx_dv |P^-1 r|; 0: not known
    double start_scale = 0;    // the same of the start, by the change of x and the estimate; 0: not known
    int32_t at_rest = 0;       // 1: the body rests, nothing was solved
};

// Where a solve starts: from zero or from x if that is better, as the settings say; or from x, whose residual is what the tolerance
// is relative to; or from zero, with z = P^-1 b in `work` (apply_to).
enum Start { WARM_START = 0, GIVEN_START = 1, APPLIED_START = 2 };

struct Preconditioner {
    const BlockCsr& A;
    const Factor* factor;
    int kind;
    double* inverse;  // (nodes, 9)
    void* work;       // 2 n doubles
    double omega;
    Correction* correction = nullptr;
    bool corrects = false;
    CutNodes* around = nullptr;  // nodes on which it is exact

    void prepare() {
        around = kind == CHOLESKY && correction && correction->cut && is_cut() ? correction->cut : nullptr;
        corrects = kind == CHOLESKY && correction && correction->capacity && Corrected{*correction, A, *factor}.prepare();
        if (kind == JACOBI || kind == BLOCK_JACOBI || kind == SSOR) invert_diagonal(A, kind != JACOBI, inverse);
    }
    // z = P^-1 r; returns z . r
    double apply(const double* r, double r_norm, double* z) {
        int n = A.size();
        if (kind == CHOLESKY && factor->bytes == 4) return with_factor<float>(r, r_norm, z);
        if (kind == CHOLESKY) return with_factor<double>(r, r_norm, z);
        if (kind == JACOBI || kind == BLOCK_JACOBI) return apply_diagonal(A, inverse, r, z);
        if (kind == SSOR) apply_ssor(A, inverse, omega, r, z);
        else std::copy(r, r + n, z);
        return dot(A, z, r);
    }
    bool is_cut() {
        CutSolve solve{*correction->cut, A};
        solve.prepare(factor->step);
        return solve.works();
    }
    // Makes it exact where A has changed most since the factor's matrix (local_refresh.h); false if that cannot be.
    bool refresh_locally() {
        if (around || !correction) return false;
        const double numbers = entries_of(*factor->pattern) + 9.0 * (A.row_start[A.last] - A.row_start[A.first]);
        if (!refresh(correction->known, A, factor->step, numbers)) return false;
        around = correction->known->room;
        return true;
    }
    template <class T>
    double with_factor(const double* r, double r_norm, double* z) {
        if (!around) return apply_alone<T>(r, r_norm, z);
        CutSolve{*around, A}.around(r, z, [&](const double* from, double* to) { apply_alone<T>(from, r_norm, to); });
        return dot(A, z, r);
    }
    template <class T>
    double apply_alone(const double* r, double r_norm, double* z) {
        const T* values = (const T*)factor->values;
        auto correct = [&](T* y) { if (corrects) Corrected{*correction, A, *factor}.between(y); };
        if (FactorPlan* plan = factor->pattern->plan) return apply_factor(*plan, values, r, 1 / r_norm, z, A.parts(), !corrects, correct);
        apply_factor(*factor->pattern, values, r, 1 / r_norm, z, (T*)work, correct);
        return dot(A, z, r);
    }
};

// Solves A x = b. work: 10 n doubles; x: start in, solution out; rests: the body is at rest; correction: of the factor, or null.
static SolveResult pcg(const BlockCsr& A, const double* b, const Factor* factor, const SolveSettings& settings, double* x,
                       double* work, bool rests = false, Correction* correction = nullptr, Start from = WARM_START) {
    double start = now();
    int n = A.size();
    double *r = work, *z = r + n, *p = z + n, *q = p + n, *inverse = q + n, *scratch = inverse + 3 * n, *before = scratch + 2 * n;
    const bool bounded = settings.position > 0;
    SolveResult out{0, 0, 0, CONVERGED, settings.kind, 0, 0, 0};
    if (out.kind == CHOLESKY && !factor) out.kind = BLOCK_JACOBI;
    IterateError<BodyNodes> error{{n / 3}, x, z, before, settings.factor_scale};
    auto finish = [&](int status, double r2, double b2) {
        error.tell(settings.dx_dv, r2, out);
        out.status = status;
        out.residual = b2 > 0 ? std::sqrt(r2 / b2) : 0;
        out.seconds = now() - start;
        return out;
    };
    auto zero = [&] { for (int i = 0; i < n; ++i) x[i] = 0; };

    double b2 = dot(A, b, b);
    if (!std::isfinite(b2)) {
        for (int i = 0; i < n; ++i) x[i] = NAN;  // the kernel `advance` takes the body back
        return finish(NOT_FINITE, b2, 1);
    }
    if (from == GIVEN_START) b2 = residual(A, b, x, r);
    else if (b2 == 0) zero();
    if (b2 == 0 || rests) out.solve_error = 0;
    if (b2 == 0) return finish(CONVERGED, 0, 0);
    double goal = settings.tolerance * settings.tolerance * b2;
    if (rests) {
        out.at_rest = 1;
        return finish(CONVERGED, residual(A, b, x, r), b2);
    }
    double r2 = from == GIVEN_START ? b2 : settings.warm_start ? residual(A, b, x, r) : b2;  // 1. r = b - A x
    if (from != GIVEN_START && (!settings.warm_start || !(r2 < b2))) {
        zero();
        for (int i = 0; i < n; ++i) r[i] = b[i];
        r2 = b2;
    }
    if (r2 <= goal) return finish(CONVERGED, r2, b2);

    Preconditioner P{A, factor, out.kind, inverse, scratch, settings.omega, correction};
    P.prepare();
    KnownDiagonals* const known = correction ? correction->known : nullptr;
    if (known) known->refreshed = 0;
    bool refreshed = known && P.kind == CHOLESKY && !bounded && from != APPLIED_START && known->slow == factor->step && P.refresh_locally();
    const double useful = bounded ? std::max(goal, USEFUL * USEFUL * b2) : goal;
    const double limit = settings.residual_limit > 0 ? settings.residual_limit * settings.residual_limit * b2 : INFINITY;
    double rz = 0, last_true = INFINITY, quarter = r2 * std::pow(useful / r2, 0.25);
    const double first_r2 = r2;
    bool restart = true, switched = false, applied = from == APPLIED_START;
    auto leave_factor = [&] {
        P.kind = out.kind = BLOCK_JACOBI;
        out.fallbacks = 1;
        P.prepare();
        r2 = residual(A, b, x, r);
        restart = true;
    };
    // Whether a solve ends by the estimate. ahead: z is of the iteration before.
    auto is_enough = [&](bool ahead) {
        return bounded && r2 <= limit && may_end(out.kind, r2, b2) && error.is_enough(settings.dx_dv, trust_of(out.kind, settings.trust), settings.position, r2, ahead);
    };
    // Whether a solve with a factor has far to go: then the factor is refreshed where A has changed most.
    auto is_slow = [&] {
        if (refreshed || P.kind != CHOLESKY || out.iterations != REFRESH_AFTER || bounded) return false;
        return !(REFRESH_AFTER * std::log(r2 / goal) < REFRESH_WORTH * std::log(first_r2 / r2));
    };
    // The status with which the solve ends by its true residual, -1: it goes on from it.
    auto ended = [&](bool enough) {
        const double found = r2;
        r2 = residual(A, b, x, r);
        if (r2 <= goal || (enough && r2 <= LOST_DIGITS * found)) return (int)CONVERGED;
        if (!(r2 < 0.25 * last_true)) return (int)MAX_ITERATIONS;                // limited by rounding: more iterations do not help
        last_true = r2;
        restart = true;
        return -1;
    };
    for (;;) {
        double zr = applied ? dot(A, z, r) : P.apply(r, std::sqrt(r2), z);       // 1. 6. z = P^-1 r
        applied = false;
        if (!(zr > 0 && zr < INFINITY)) {                                        // also NaN
            if (P.kind != CHOLESKY) return finish(BREAKDOWN_PRECONDITIONER, residual(A, b, x, r), b2);
            leave_factor();
            continue;
        }
        error.apply(out.kind, zr, r2);
        if (out.iterations == 0) error.first_size = error.nodes.peak(z);
        if (is_enough(false)) {
            const int status = ended(true);
            if (status >= 0) return finish(status, r2, b2);
            continue;
        }
        conjugate(A, restart ? 0 : zr / rz, z, p);                               // 7. 8. p = z + beta p
        rz = zr;
        restart = false;
        if (out.iterations == settings.max_iterations) return finish(MAX_ITERATIONS, residual(A, b, x, r), b2);
        if (P.kind == CHOLESKY && settings.max_iterations >= ENOUGH && out.iterations == settings.max_iterations / 2 && !(r2 < quarter)) {
            leave_factor();
            continue;
        }
        if (out.iterations == settings.probe && settings.probe > 0 && factor && (P.kind == BLOCK_JACOBI || P.kind == CHOLESKY) && !switched) {
            P.kind = out.kind = P.kind == CHOLESKY ? BLOCK_JACOBI : CHOLESKY;
            P.prepare();
            out.switched_after = out.iterations;
            out.residual_then = std::sqrt(r2 / b2);
            switched = restart = true;
            continue;
        }
        bool spent = settings.budget > 0 ? out.iterations > 0 && now() - start > settings.budget : out.iterations + 1 == -settings.budget;
        if (settings.deadline > 0 && out.iterations > 0) spent = spent || now() > settings.deadline;
        if (spent) return finish(BUDGET, residual(A, b, x, r), b2);

        error.look();
        double pq = multiply(A, p, q);
        ++out.iterations;
        if (!(pq > 0)) return finish(BREAKDOWN_MATRIX, residual(A, b, x, r), b2);
        r2 = descend(A, rz / pq, p, q, x, r);                                    // 3. 4. 5.
        error.move(rz / pq);
        const bool enough = is_enough(true);
        if (r2 > goal && !enough) {
            if (is_slow() && P.refresh_locally()) {
                refreshed = restart = true;
                known->slow = factor->step;
                error.forget();
            }
            continue;
        }
        const int status = ended(enough);
        if (status >= 0) return finish(status, r2, b2);
    }
}

// z = P^-1 b, with b and z in `work` where a solve of APPLIED_START looks for them; returns |z|, NaN where P is not positive.
static double apply_to(const BlockCsr& A, const double* b, const Factor* factor, int kind, double omega, double* work,
                       Correction* correction) {
    const int n = A.size();
    double *r = work, *z = r + n, *inverse = z + 3 * n, *scratch = inverse + 3 * n;
    const double norm = std::sqrt(dot(A, b, b));
    std::copy(b, b + n, r);
    if (norm == 0) return 0;
    Preconditioner P{A, factor, kind, inverse, scratch, omega, correction};
    P.prepare();
    const double zr = P.apply(r, norm, z);
    return zr > 0 && zr < INFINITY ? BodyNodes{n / 3}.peak(z) : not_known();
}
