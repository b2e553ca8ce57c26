// SPDX-License-Identifier: MIT
// What is known of the error of an iterate on a GPU (method: kernels/error_estimate.cuh; decisions: backends/cpu/native/iterate_error.h). It
// is in shared memory, and one thread of a thread block changes it; all thread blocks come to the same.
#pragma once
#include "error_estimate.cuh"
#include "pcg_structs.cuh"

constexpr double LOST_DIGITS = 1.1;   // as in backends/cpu/native/pcg.h
constexpr double USEFUL = 1e-6;       // as in backends/cpu/native/pcg.h

struct IterateError {
    double position, trust, dx_dv;       // see SolveSettings (backends/cpu/native/pcg.h); position 0: none
    double limit2;                       // square of the residual that an estimate leaves at most
    double b2;                           // square of the residual that the solve began with, or of b
    int kind, iterations, looked;        // looked: iterations at the last look at x, -1: none yet
    bool enough, near, looks;            // decisions of the iteration, for all threads
    double rz, r2, size;                 // of the last z; r2 0: there is none
    double alpha, alpha_before;          // of the last iteration, and the largest one before
    double first_size, travelled;        // |z| at the start; sum of the changes of x between looks
    double rz_looked, lagged;            // lagged: |e| by the iterates at the last look, -1: not known

    __device__ __forceinline__ void begin(double position_now, double trust_now, double dx_dv_now) {
        position = position_now;
        trust = trust_now;
        dx_dv = dx_dv_now;
        limit2 = 1e300;
        b2 = rz = 0;
        kind = NONE;
        iterations = 0;
        first_size = travelled = 0;
        enough = near = looks = false;
        forget();
    }
    // The solve is one of both of a Rosenbrock-W step.
    __device__ __forceinline__ void of_stage(bool first) {
        position /= 2;
        dx_dv *= first ? BY_FIRST : BY_SECOND;
    }
    __device__ __forceinline__ void forget() {
        looked = -1;
        lagged = -1;
        alpha = alpha_before = r2 = size = rz_looked = 0;
    }

    // By z alone; below 0: not known.
    __device__ __forceinline__ double by_factor(double fall) const {
        return r2 > 0 && alpha > 0 ? error_by_factor(kind, size, factor_scale_of(alpha, alpha_before), fall) : -1;
    }
    __device__ __forceinline__ double by_iterates(double rz_now, double change) const {
        const double by_last = lagged < 0 ? -1 : lagged * sqrt(fmin(1.0, rz_now / rz_looked));
        if (looked < 0 || iterations - looked < fewest_of(kind)) return by_last;
        return fmax(by_last, error_by_iterates(change, rz_now, rz_looked));
    }
    // |e| of an iterate whose residual has the square r2_now, NaN: not known. change: |x - x at the last look|.
    __device__ __forceinline__ double estimate(double r2_now, double change) const {
        if (!(r2 > 0)) return not_known();
        const double fall = sqrt(r2_now / r2), x_tells = by_iterates(rz * fall * fall, change);
        double z_tells = by_factor(fall);
        if (x_tells >= 0 && kind != CHOLESKY && alpha > 0) z_tells /= FEW;
        const double e = fmax(x_tells, z_tells);
        return e >= 0 ? e : not_known();
    }
    // Whether z alone tells enough, so that it is worth while to look at the iterates. ahead: z is of the iteration before.
    __device__ __forceinline__ bool looks_enough(double r2_now, bool ahead) const {
        if (!(position > 0 && r2_now <= limit2 && may_end(kind, r2_now, b2))) return false;
        const double cheap = dx_dv * by_factor(sqrt(least(r2_now, ahead) / r2)) / (kind == CHOLESKY ? 1 : FEW);
        return cheap >= 0 && is_exact_enough(cheap, trust_of(kind, trust), position, ahead);
    }
    __device__ __forceinline__ bool is_enough(double r2_now, double change, bool ahead) const {
        return looks_enough(r2_now, ahead) &&
               is_exact_enough(dx_dv * estimate(least(r2_now, ahead), change), trust_of(kind, trust), position, ahead);
    }
    __device__ __forceinline__ double least(double r2_now, bool ahead) const {
        return ahead ? fmax(r2_now, LEAST_FALL * LEAST_FALL * r2) : r2_now;
    }

    // z = P^-1 r of the residual whose square is r2_now; size: |z|. Decides whether the solve ends here, or else whether x is kept to be
    // looked at.
    __device__ __forceinline__ void apply(int kind_now, double zr, double r2_now, double z_size, double change) {
        if (kind_now != kind && kind != NONE) forget();
        kind = kind_now;
        rz = zr;
        r2 = r2_now;
        size = z_size;
        if (iterations == 0) first_size = z_size;
        enough = is_enough(r2_now, change, false);
        looks = !enough && (looked < 0 || iterations - looked >= lag_of(looked));
        if (!looks) return;
        if (looked >= 0) {
            lagged = error_by_iterates(change, zr, rz_looked);
            travelled += change;
        }
        looked = iterations;
        rz_looked = zr;
    }
    // An iteration is done. Decides whether the iterates are to be asked.
    __device__ __forceinline__ void move(double by, double r2_now) {
        alpha_before = alpha > 0 ? fmax(alpha, alpha_before) : by;
        alpha = by;
        ++iterations;
        near = looks_enough(r2_now, true);
    }
    // Scale of P^-1 at a trial, known: that of an earlier solve. That of a factor is told by the end of a solve, that of another
    // preconditioner by its start (backends/cpu/native/newton.h).
    __device__ __forceinline__ double scale(double r2_now, double change, double known) const {
        const double e = estimate(r2_now, change), last = size * sqrt(r2_now / r2);
        if (!(alpha > 0 && e > 0)) return known;
        const double at_end = last > 0 ? e / last : 0, at_start = first_size > 0 ? (travelled + (looked >= 0 ? change : 0) + e) / first_size : 0;
        const double larger = fmax(at_end, at_start);
        return larger > 0 ? larger : known;
    }
    // Estimated error of the solution [m], 0: not known.
    __device__ __forceinline__ double told(double r2_now, double change) const {
        const double e = alpha > 0 ? dx_dv * estimate(r2_now, change) : 0;
        return e > 0 ? e : 0;
    }
};
