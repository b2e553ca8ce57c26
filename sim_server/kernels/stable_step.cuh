// SPDX-License-Identifier: MIT
// The stable step of central differences, and the substeps of a step; shared by both devices (backends/cpu/native/
// central_difference.h, backends/gpu/central_difference.cu). Method and sources: mechanics/central_difference.py.
//
// The largest angular frequency w of a body, w^2 the largest eigenvalue of M^-1 K, comes from differences of the forces,
// K u = f(x) - f(x + u) for small u, at the present state and with all that acts on it. Before the first step a power iteration
// from random numbers finds it, w^2 = |M^-1 K u| / |u| in the norm of M. Then u gets the same length at every node, in the direction
// of (M^-1 K u)_i: what stiffens anywhere is seen at once, as the largest quotient q = |(M^-1 K u)_i| / |u_i| of all nodes. w^2 / q
// is known from the first step; later w^2 is this ratio times the largest q of the moment.
#pragma once
#include "energy_balance.cuh"

constexpr int POWER_ITERATIONS = 60;  // before the first step
constexpr int FIRST_ITERATIONS = 68;  // with those that find the ratio of w^2 and q
constexpr int ESTIMATE_EVERY = 8;     // substeps between two estimates of one iteration
constexpr int RETRIES = 4;            // of a step that ran away: each halves the substeps
constexpr int MOST_SUBSTEPS = 1048576;  // of the first step
constexpr int MOST_MORE = 16, MOST_AT_LEAST = 1024;  // a step has at most so many times those of the first step, or so many
constexpr double SAFETY = 0.9;        // part of the stable step that a step begins with
constexpr double LIMIT = 0.95;        // where the substep exceeds this part of it within a step the rest is made with SAFETY again
constexpr double FEWER = 0.8;         // fewer substeps are taken only where this part of them would do
constexpr double DECLINE = 0.95;      // and never less than this part of the last ones
struct StableStep {    // of a body
    double omega;      // estimated largest angular frequency; 0: nothing couples its nodes [1/s]
    double amplitude;  // of u [m]
    double beta;       // Rayleigh damping of the stiffness [s]
    double ratio;      // omega^2 / q
};

struct SubstepState {
    int substeps;   // of the step; 0: before the first
    int most;       // that a step may have
    int left;       // of these, in the step under way
    int since;      // substeps since the last estimate
    int tries;      // of the step under way
    int round;      // substeps come in multiples of it
};

struct ModeSums {  // over the free nodes of a body, with w = M^-1 K u
    double mode, next;         // sums of m u.u and m w.w
    double largest, quotient;  // of a node: w.w, and w.w / u.u
};

HOST_DEVICE ModeSums no_mode() { return {0, 0, 0, 0}; }

HOST_DEVICE void join(ModeSums& a, const ModeSums& b) {
    a.mode += b.mode;
    a.next += b.next;
    a.largest = b.largest > a.largest ? b.largest : a.largest;
    a.quotient = b.quotient > a.quotient ? b.quotient : a.quotient;
}

// Adds a free node. forces: at x and at x + u.
template <class T>
HOST_DEVICE void add_mode(ModeSums& s, double mass, const T* u, const T* force, const T* force_at_u) {
    double mode = 0, next = 0;
    for (int c = 0; c < 3; ++c) {
        const double w = ((double)force[c] - force_at_u[c]) / mass;
        mode += (double)u[c] * u[c];
        next += w * w;
    }
    join(s, {mass * mode, mass * next, next, mode > 0 ? next / mode : 0});
}

// Uniform in [-1, 1), the same on both devices.
HOST_DEVICE double random_number(unsigned k) {
    k ^= k >> 16;
    k *= 0x7feb352du;
    k ^= k >> 15;
    k *= 0x846ca68bu;
    k ^= k >> 16;
    return k * (1.0 / 2147483648.0) - 1;
}

// Notes the frequency after iteration k of the first estimate, or of a later one (k = FIRST_ITERATIONS).
HOST_DEVICE void note_frequency(StableStep& body, const ModeSums& s, int k) {
    if (!is_finite(s.next) || s.mode == 0) {
        if (k < FIRST_ITERATIONS) body.omega = 0;
        return;
    }
    const double q = sqrt(s.quotient);
    if (k < POWER_ITERATIONS) body.omega = sqrt(sqrt(s.next / s.mode));
    else if (k < FIRST_ITERATIONS) body.ratio = q > 0 ? body.omega * body.omega / q : 0;
    else body.omega = sqrt(body.ratio * q);
}

// Makes u of a free node for the iteration after k.
template <class T>
HOST_DEVICE void next_mode(const StableStep& body, const ModeSums& s, int k, int node, double mass, const T* force, const T* force_at_u, T* u) {
    double w[3], size = 0;
    for (int c = 0; c < 3; ++c) {
        w[c] = ((double)force[c] - force_at_u[c]) / mass;
        size += w[c] * w[c];
    }
    if (!is_finite(s.next)) return;
    const double longest = k < POWER_ITERATIONS ? s.largest : size;
    if (longest > 0)
        for (int c = 0; c < 3; ++c) u[c] = (T)(body.amplitude / sqrt(longest) * w[c]);
    else
        for (int c = 0; c < 3; ++c) u[c] = (T)(body.amplitude * random_number(3u * node + c));
}

// Stable step: 2 / w, less with damping of the stiffness, whose force is that of the velocity before the substep [s].
HOST_DEVICE double stable_step_of(const StableStep& body) {
    const double ratio = body.beta * body.omega / 2;
    return body.omega > 0 ? 2 / body.omega * (sqrt(1 + ratio * ratio) - ratio) : 1e300;
}

HOST_DEVICE int substeps_within(double time, double stable, int most, int round) {
    const double wanted = time / (SAFETY * stable);
    const int found = wanted < 1 ? 1 : wanted < most ? (int)ceil(wanted) : most;
    return (found + round - 1) / round * round;
}

// Sets the substeps of a step of dt [s] in which the stable step of all bodies is `stable` [s].
HOST_DEVICE void begin_step(SubstepState& s, double dt, double stable) {
    const int last = s.substeps, needed = substeps_within(dt, stable, last ? s.most : MOST_SUBSTEPS, s.round), least = (int)(DECLINE * last) / s.round * s.round;
    if (!last) s.most = MOST_MORE * needed > MOST_AT_LEAST ? MOST_MORE * needed : MOST_AT_LEAST;
    s.substeps = needed >= last ? needed : needed > FEWER * last ? last : needed > least ? needed : least;
    s.tries = 0;
}

// Makes more substeps of the rest of a step if that is needed. substep: their length [s]; shift: out, what a position that is half a
// substep ahead has to move by, over its velocity [s]. False: nothing changes.
HOST_DEVICE bool shorten(SubstepState& s, double stable, double* substep, double* shift) {
    const double time = s.left * substep[0];
    const int most = s.most - s.substeps + s.left;
    const int left = substep[0] > LIMIT * stable ? substeps_within(time, stable, most, s.round) : s.left;
    if (left <= s.left) return false;
    *shift = (time / left - substep[0]) / 2;
    substep[0] = time / left;
    s.substeps += left - s.left;
    s.left = left;
    return true;
}

// Whether a step that ran away is made again, with half the substep.
HOST_DEVICE bool try_again(SubstepState& s) {
    if (s.tries == RETRIES || 2 * s.substeps > s.most) return false;
    s.substeps *= 2;
    ++s.tries;
    return true;
}
