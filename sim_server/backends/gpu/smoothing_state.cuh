// SPDX-License-Identifier: MIT
// What a solve goes over to when its factor is too old for what happened. Such a factor is still right for motions of the whole body, and
// wrong where the body has bent or folded: a few hundredths of the nodes, whose stiffness block Jacobi knows. So the factor becomes
// the coarse part of a method of two levels, with a sweep of block Jacobi before it and one after it, of weight w:
//     z1 = w D^-1 r,   z2 = z1 + P^-1 (r - A z1),   z = z2 + w D^-1 (r - A z2).
// It is symmetric, and positive definite where P is and w times the largest eigenvalue of D^-1 A is below 2. An iteration has three products
// by A in place of one, and there are about a third as many.
//
// Its loop is a kernel of its own (smoothed.cu), which returns at once where no solve needs it, so that the text of pcg.cu stays as it is.
#pragma once
#include "pcg_structs.cuh"
#include "kinds.h"

constexpr int SMOOTH_AFTER = 8;        // iterations of a solve
constexpr int STILL_SLOW = 6;          // smoothed iterations below which later solves begin without again
constexpr int SMOOTH_ENOUGH = 40;      // of them, after which a quarter of the way should be behind
constexpr double SMOOTH_WEIGHT = 0.5;  // eigenvalues of D^-1 A are at most 4 with elements of four nodes
constexpr int SLOW = 1000;             // status of a solve that goes on
constexpr int NEVER = 0x7fffffff;

// Iterations after which a solve may go over: 0 if one was slow with this factor before, NEVER if that did not help.
__device__ __forceinline__ int smoothing_limit(const PcgBody& body, long long slow) {
    if (!body.plan || body.kind != CHOLESKY || body.probe > 0 || slow == -2 - body.factor_step) return NEVER;
    return slow == body.factor_step ? 0 : SMOOTH_AFTER;
}

// What a smoothed solve leaves to those that follow.
__device__ __forceinline__ long long slow_after(bool useless, int iterations, long long factor_step) {
    if (useless) return -2 - factor_step;
    return iterations < STILL_SLOW ? -1 : factor_step;
}

// Whether a solve would still need more than twice the iterations that took it from first_r2 to r2: r2 / goal > (first_r2 / r2)^2,
// without divisions, whose code would be in the loop of pcg.cu.
__device__ __forceinline__ bool is_slow(int iterations, double first_r2, double r2, double goal) {
    return iterations == 0 || !(r2 * r2 * r2 < goal * first_r2 * first_r2);
}
