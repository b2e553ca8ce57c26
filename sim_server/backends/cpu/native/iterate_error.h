// SPDX-License-Identifier: MIT
// What is known of the error of an iterate on a CPU (method: kernels/error_estimate.cuh), by Nodes: the nodes of a body or of an island.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "error_estimate.cuh"

// Square of the largest norm of a node.
static double peak2(int nodes, const double* a) {
    double most = 0;
    for (int i = 0; i < nodes; ++i, a += 3) most = std::max(most, a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
    return most;
}
// The same of a - b.
static double peak2(int nodes, const double* a, const double* b) {
    double most = 0;
    for (int i = 0; i < nodes; ++i, a += 3, b += 3) {
        const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
        most = std::max(most, d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    }
    return most;
}

struct BodyNodes {
    const int nodes;
    double peak(const double* a) const { return std::sqrt(peak2(nodes, a)); }
    double change(const double* a, const double* b) const { return std::sqrt(peak2(nodes, a, b)); }
    void copy(const double* from, double* to) const { std::copy(from, from + 3 * (int64_t)nodes, to); }
};

template <class Nodes> struct IterateError {
    const Nodes nodes;
    const double *x, *z;
    double* before;           // x at the last look
    double given_scale;       // of an earlier solve of the step, 0: not known
    int kind = NONE, iterations = 0;
    double rz = 0, r2 = 0;    // of z
    double size = -1;         // |z|, -1: not looked at
    double alpha = 0, alpha_before = 0;  // of the last iteration, and the largest one before
    int looked = -1;          // iterations at the last look, -1: none yet
    double rz_looked = 0;
    double lagged = -1;       // |e| by the iterates then, -1: not known

    // What P^-1 and the iterates have told is of another kind.
    void forget() {
        looked = -1;
        lagged = -1;
        alpha = alpha_before = given_scale = r2 = 0;
    }
    // z is P^-1 of the residual whose square is r_now2.
    void apply(int kind_now, double zr, double r_now2) {
        if (kind_now != kind && kind != NONE) forget();
        kind = kind_now;
        rz = zr;
        r2 = r_now2;
        size = -1;
    }
    // An iteration follows: looks at x where it is time.
    void look() {
        if (looked >= 0 && iterations - looked < lag_of(looked)) return;
        if (looked >= 0) lagged = error_by_iterates(nodes.change(x, before), rz, rz_looked);
        nodes.copy(x, before);
        looked = iterations;
        rz_looked = rz;
    }
    void move(double by) {
        alpha_before = alpha > 0 ? std::max(alpha, alpha_before) : by;
        alpha = by;
        ++iterations;
    }
    // By z alone; below 0: not known.
    double by_factor(double fall) {
        if (!(r2 > 0)) return -1;
        if (size < 0) size = nodes.peak(z);
        if (alpha > 0) return error_by_factor(kind, size, factor_scale_of(alpha, alpha_before), fall);
        return given_scale > 0 ? given_scale * size * fall : -1;
    }
    double by_iterates(double rz_now) const {
        const int d = iterations - looked;
        const double by_last = lagged < 0 ? -1 : lagged * std::sqrt(std::min(1.0, rz_now / rz_looked));
        if (looked < 0 || d < fewest_of(kind)) return by_last;
        return std::max(by_last, error_by_iterates(nodes.change(x, before), rz_now, rz_looked));
    }
    // |e| of x, whose residual has the square r_now2; NaN: not known.
    double estimate(double r_now2) {
        if (!(r2 > 0)) return not_known();
        const double fall = std::sqrt(r_now2 / r2), x_tells = by_iterates(rz * fall * fall);
        double z_tells = by_factor(fall);
        if (x_tells >= 0 && kind != CHOLESKY && alpha > 0) z_tells /= FEW;
        const double e = std::max(x_tells, z_tells);
        return e >= 0 ? e : not_known();
    }
    // Puts the estimate into the result of a solve; of P^-1 its scale, 0 where that is not known.
    template <class Result> void tell(double dx_dv, double r_now2, Result& out) {
        if (!(alpha > 0 || given_scale > 0)) return;
        const double e = estimate(r_now2);
        out.solve_error = dx_dv * e;
        out.factor_scale = size > 0 && e > 0 ? e / (size * std::sqrt(r_now2 / r2)) : 0;
    }
    // Whether the estimate is within `position`. ahead: z is of the iteration before.
    bool is_enough(double dx_dv, double trust, double position, double r_now2, bool ahead) {
        if (ahead) r_now2 = std::max(r_now2, LEAST_FALL * LEAST_FALL * r2);
        const double cheap = dx_dv * by_factor(std::sqrt(r_now2 / r2)) / (kind == CHOLESKY ? 1 : FEW);
        return cheap >= 0 && is_exact_enough(cheap, trust, position, ahead) &&
               is_exact_enough(dx_dv * estimate(r_now2), trust, position, ahead);
    }
};
