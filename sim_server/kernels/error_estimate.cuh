// SPDX-License-Identifier: MIT
// Estimates of the error e = A^-1 r of an iterate x of conjugate gradients, shared by both devices. |.| is the largest Euclidean norm of
// a node's part; the frame of the nodes does not matter. In a step, dx_dv |e| is the error of the positions [m].
//
//   - By P^-1: z = P^-1 r is e itself where P is A, and near it where P is an older factor. alpha of an iteration is the mean of the
//     eigenvalues of A^-1 P as its direction sees them: where it exceeds MOST_ALPHA P is too large, and alpha z is meant.
//   - By the iterates: x_k - x_(k-d) is what d iterations took off the error, and sqrt(z.r) falls as the error in the norm of A does.
// Where both are known the larger one counts. `trust` times an estimate is at least the error, as tests/accuracy measures: of a body
// whose factor is far too stiff in a part of it, as where contacts have ended that it still knows, the error may be several times more;
// likewise where conjugate gradients stand still before they have seen the softest modes (block Jacobi in quasi-static scenes).
#pragma once
#ifndef __CUDACC__
#include <cmath>
#endif
#include "host_device.cuh"
#include "kinds.h"
#include "step_form.h"

constexpr double WARPED_TRUST = 1.5;  // with factors in the material frame
constexpr double FACTOR_TRUST = 3;    // with factors in the world frame
constexpr double OTHER_TRUST = 3;     // with other preconditioners
constexpr double AHEAD = 2;           // and so many times more where z is of the iteration before
constexpr double LEAST_FALL = 0.01;   // of the error in an iteration, as far as the fall of |r| is taken for it ahead: springs and contacts
                                      // of a few nodes are much of |r|, and little of the error
constexpr double FEW = 5;             // of z with other preconditioners, where fewer than FEWEST iterations are done
constexpr int LAG = 10;               // iterations d from one look at x to the next, at least
constexpr int FEWEST = 4, FEWEST_WITH_FACTOR = 1;  // from which on the iterates tell
constexpr double MOST_LEFT = 0.1;     // of |b|: a solve with more of a residual does not end by an estimate
constexpr double MOST_ALPHA = 10;     // up to which P^-1 is taken as it is
constexpr double SLOWEST = 0.95;      // fall of the error in d iterations; what falls less is taken for it

constexpr double WITHIN = 0.5;        // part of the law's tolerance that the last pass of contact may leave where it ends by an estimate

// Derivatives of the positions after a Rosenbrock-W step by u_1 and u_2, over h (mechanics/rosenbrock.py); by u_1 at unchanged forces.
constexpr double BY_FIRST = (1 + 1 / ROS2_GAMMA) / 2, BY_SECOND = 0.5;

// In place of an estimate that there is not.
HOST_DEVICE double not_known() { return nan(""); }

// Times an estimate of this kind is at least the error. trust_in_factor: WARPED_TRUST or FACTOR_TRUST.
HOST_DEVICE double trust_of(int kind, double trust_in_factor) { return kind == CHOLESKY ? trust_in_factor : OTHER_TRUST; }

// Iterations from which on the iterates tell.
HOST_DEVICE int fewest_of(int kind) { return kind == CHOLESKY ? FEWEST_WITH_FACTOR : FEWEST; }

// Whether an estimate may end a solve, with squares of |r| and |b|.
HOST_DEVICE bool may_end(double r2, double b2) { return r2 <= MOST_LEFT * MOST_LEFT * b2; }

// Iterations from one look at x to the next: more where convergence is slow.
HOST_DEVICE int lag_of(int looked) { return looked / 2 > LAG ? looked / 2 : LAG; }

// Scale of P^-1 by alpha of the last iteration and the largest one before; 1 where nothing is wrong. Never less: stiff springs that P
// does not know make alpha small, too.
HOST_DEVICE double factor_scale_of(double alpha, double alpha_before) {
    const double larger = alpha > alpha_before ? alpha : alpha_before;
    return larger > MOST_ALPHA ? larger : 1;
}

// |e| by z = |P^-1 r_k|. fall: |r| now over |r_k|, 1 where z is of now.
HOST_DEVICE double error_by_factor(int kind, double z, double scale, double fall) { return (kind == CHOLESKY ? scale : FEW * scale) * z * fall; }

// |e_k| by change = |x_k - x_(k-d)|. rz, rz_before: z.r at k and at k - d. With q the fall of the error, change is about (1 - q) of the
// error at k - d, and q / (1 - q) of it is left.
HOST_DEVICE double error_by_iterates(double change, double rz, double rz_before) {
    const double q = rz < SLOWEST * SLOWEST * rz_before ? sqrt(rz / rz_before) : SLOWEST;
    return change * q / (1 - q);
}

// Whether a solve may end. estimate: dx_dv |e|; ahead: z in it is of the iteration before.
HOST_DEVICE bool is_exact_enough(double estimate, double trust, double position, bool ahead) {
    return (ahead ? AHEAD * trust : trust) * estimate <= position;
}
