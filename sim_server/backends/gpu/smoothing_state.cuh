// SPDX-License-Identifier: MIT
// What a solve goes over to when its factor is too old for what happened. Such a factor is still right for motions of the whole body, and
// wrong where the body has bent or folded: a few hundredths of the nodes, whose stiffness block Jacobi knows. So the factor becomes
// the coarse part of a method of two levels, with one or two sweeps of block Jacobi before it and as many after it:
//     z1 = s(D^-1 A) D^-1 r,   z2 = z1 + P^-1 (r - A z1),   z = z2 + s(D^-1 A) D^-1 (r - A z2),
// 1 - a s(a) the Chebyshev polynomial of the first or second degree that is small for the upper three quarters of the eigenvalues of D^-1 A
// (Adams, Brezina, Hu, Tuminaro, Parallel multigrid smoothing: polynomial versus Gauss-Seidel, 2003). It is symmetric, and positive definite where
// P is and these are below 5/4 of what was estimated. An iteration has three or five products by A in place of one.
//
// Small bodies, whose products take about as long as an application, do so in slow solves. Of large ones an application takes as long as ten
// products, and fine meshes resolve what a factor of a few steps ago does not know, so that they do it in all solves but the shortest.
//
// Its loop is a kernel of its own (smoothed.cu), which returns at once where no solve needs it, so that the text of pcg.cu stays as it is.
#pragma once
#include "pcg_structs.cuh"
#include "kinds.h"

constexpr int LARGE_NODES = 50000;     // of a body
constexpr int SMOOTH_AFTER = 8;        // iterations of a solve
constexpr int SMOOTH_SOON = 2;         // likewise of a large body
constexpr int STILL_SLOW = 6;          // smoothed iterations below which later solves begin without again
constexpr int STILL_MANY = 2;          // likewise of a large body
constexpr int TWO_SWEEPS = 6;          // from which on later ones of a large body have two sweeps, as all of small ones
constexpr int STILL_TWO = 4;           // and below which they have one again
constexpr int SMOOTH_ENOUGH = 40;      // after which a quarter of the way should be behind
constexpr double RANGE = 4;            // of the eigenvalues that are smoothed, largest over smallest
constexpr int POWER_STEPS = 12;        // for an estimate of the largest
constexpr double POWER_MARGIN = 1.05;  // it is a few hundredths too small
constexpr int SLOW = 1000;             // status of a solve that goes on
constexpr int NEVER = 0x7fffffff;

// `slow` of a body: -1: solves begin with the factor alone; -2 - s: with the factor of step s smoothing was of no use; 2 s + m: one was slow
// with the factor of step s, and the next one has m + 1 sweeps.

// Iterations after which a solve may go over: 0 if one was slow with this factor before, NEVER if that did not help.
__device__ __forceinline__ int smoothing_limit(const PcgBody& body, long long slow) {
    if (!body.plan || body.kind != CHOLESKY || body.probe > 0 || slow == -2 - body.factor_step) return NEVER;
    if (body.nodes >= LARGE_NODES) return slow >= 0 ? 0 : SMOOTH_SOON;
    return slow >= 0 && slow / 2 == body.factor_step ? 0 : SMOOTH_AFTER;
}

// Sweeps before and after the factor.
__device__ __forceinline__ int smoothing_sweeps(const PcgBody& body, long long slow) {
    return body.nodes < LARGE_NODES || (slow >= 0 && slow % 2 > 0) ? 2 : 1;
}

// What a smoothed solve leaves to those that follow.
__device__ __forceinline__ long long slow_after(const PcgBody& body, bool useless, int iterations, int sweeps) {
    const bool large = body.nodes >= LARGE_NODES;
    if (useless) return -2 - body.factor_step;
    if (iterations < (large ? STILL_MANY : STILL_SLOW)) return -1;
    return 2 * body.factor_step + (iterations >= (sweeps > 1 ? STILL_TWO : TWO_SWEEPS));
}

// Whether a solve is to go over. Of a small body: if it would still need more iterations than took it from first_r2 to r2,
// r2 / goal > first_r2 / r2, without divisions, whose code would be in the loop of pcg.cu.
__device__ __forceinline__ bool is_slow(int nodes, int iterations, double first_r2, double r2, double goal) {
    return iterations == 0 || nodes >= LARGE_NODES || !(r2 * r2 < goal * first_r2);
}

// Weights of the sweeps of a smoothing for the eigenvalues of D^-1 A from largest / RANGE to largest: what the first one takes of D^-1 times
// the residual, and the second one of that and of what the first one has added.
struct SweepWeights {
    double first, second, before;

    static __device__ __forceinline__ SweepWeights of(double largest) {
        const double middle = 0.5 * largest * (1 + 1 / RANGE), half = 0.5 * largest * (1 - 1 / RANGE);
        const double rho = half / middle, next = 1 / (2 / rho - rho);
        return {1 / middle, 2 * next / half, rho * next};
    }
};
