// SPDX-License-Identifier: MIT
// Estimates of the error e = A^-1 r of an iterate x of conjugate gradients, shared by both devices. |.| is the largest Euclidean norm of
// a node's part; the frame of the nodes does not matter. In a step, dx_dv |e| is the error of the positions [m].
//
//   - By P^-1: z = P^-1 r is e itself where P is A, and near it where P is an older factor. alpha of an iteration is the mean of the
//     eigenvalues of A^-1 P as its direction sees them: single ones scatter, but several beyond SCALE_RANGE say that P has a wrong
//     scale, and then alpha z is meant.
//   - By the iterates: x_k - x_(k-d) is what d iterations took off the error, and sqrt(z.r) falls as the error in the norm of A does.
//     Right with any preconditioner once d is FEWEST or more.
// Where both are known the larger one counts. `trust` times an estimate is at least the error, as tests/accuracy measures.
#pragma once
#ifndef __CUDACC__
#include <cmath>
#endif
#include "host_device.cuh"
#include "kinds.h"

constexpr double WARPED_TRUST = 1.5;  // with factors in the material frame
constexpr double FACTOR_TRUST = 3;    // with factors in the world frame
constexpr double OTHER_TRUST = 2.5;   // with other preconditioners
constexpr double AHEAD = 2;           // and so many times more where z is of the iteration before
constexpr double FEW = 5;             // of z with other preconditioners, where fewer than FEWEST iterations are done
constexpr int LAG = 10, FEWEST = 4;   // iterations d: between two looks at x; from which on the iterates tell
constexpr double SCALE_RANGE = 10;

// In place of an estimate that there is not.
HOST_DEVICE double not_known() { return nan(""); }

HOST_DEVICE double trust_of(int kind, double trust_in_factor) { return kind == CHOLESKY ? trust_in_factor : OTHER_TRUST; }

// Scale of P^-1 by alpha of the last two iterations; 1 where nothing is wrong.
HOST_DEVICE double factor_scale_of(double alpha, double alpha_before) {
    const double larger = alpha > alpha_before ? alpha : alpha_before;
    return larger > SCALE_RANGE || larger < 1 / SCALE_RANGE ? larger : 1;
}

// |e| by z = |P^-1 r_k|. fall: |r| now over |r_k|, 1 where z is of now.
HOST_DEVICE double error_by_factor(int kind, double z, double scale, double fall) { return (kind == CHOLESKY ? scale : FEW * scale) * z * fall; }

// |e_k| by change = |x_k - x_(k-d)|. rz, rz_before: z.r at k and at k - d.
HOST_DEVICE double error_by_iterates(double change, double rz, double rz_before) {
    return change * (rz < rz_before ? sqrt(rz / rz_before) : 1);
}

// Whether a solve may end. estimate: dx_dv |e|; ahead: z in it is of the iteration before.
HOST_DEVICE bool is_exact_enough(double estimate, double trust, double position, bool ahead) {
    return (ahead ? AHEAD * trust : trust) * estimate <= position;
}
