// SPDX-License-Identifier: MIT
// Where the iterations of the next step start (mechanics/guess.py).
#define WIDE
#include "coalesced_io.cuh"
#include "mat3.cuh"

constexpr int ORDERS = 5;  // polynomials of degree 0 to 4 through the last solutions

#ifdef __CUDACC_RTC__  // to single precision, by one instruction: divisions of doubles would take as long as the rest
INLINE number reciprocal(number a) { float root = rsqrtf((float)a); return root * root; }
#else
INLINE number reciprocal(number a) { return 1 / a; }
#endif

struct Extrapolate {
    int n;              // nodes
    const real* dv;     // (n, 3) solution of the step, world frame [m/s]
    real* differences;  // (n, 15) in, out: backward differences of order 0 to 4 of the solutions up to this one [m/s]
    real* guess;        // (n, 3) out: of the next solution [m/s]
};

// Mean of the extrapolations of all degrees, each weighted by the inverse square of what its error was in this step: the difference of
// the next order. So it is of high degree where the motion is smooth, and hardly more than the last solution where it is not. A higher degree
// counts less, as after a jump the differences of all orders are equal.
KERNEL(extrapolate, Extrapolate) {
    vec3 dv = load3(p.dv, i), difference = dv, change = {}, sum = {}, zero = {};
    number total = number{} + (real)1e-30, row[3 * ORDERS];  // 1e-30: no reciprocal is infinite, in float32 either
    real trust = 1;
    for (int k = 0; k < ORDERS; ++k) {
        vec3 before = {row_at<3 * ORDERS>(p.differences, i, 3 * k), row_at<3 * ORDERS>(p.differences, i, 3 * k + 1),
                       row_at<3 * ORDERS>(p.differences, i, 3 * k + 2)};
        row[3 * k] = difference.x;
        row[3 * k + 1] = difference.y;
        row[3 * k + 2] = difference.z;
        if (k > 0) change = change + difference;  // to the next solution, by the polynomial of degree k
        difference = difference - before;
        number weight = trust * reciprocal(dot(difference, difference) + (real)1e-30);
        total += weight;
        sum = sum + weight * change;
        trust *= (real)0.45;
    }
    auto finite = dot(sum, zero) == 0;
    put_row(p.differences, i, p.n, row);
    vec3 guess = select(finite, dv + reciprocal(total) * sum, dv);
    put_row(p.guess, i, p.n, {guess.x, guess.y, guess.z});
}
