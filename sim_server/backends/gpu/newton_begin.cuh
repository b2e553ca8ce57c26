// SPDX-License-Identifier: MIT
// The beginning of Newton-Raphson within a step on a GPU (newton.cu), after the forces of its first assembly. It reads no blocks off the
// diagonal, so that it is done beside the kernel that makes these (kernel_fusion.py).
#pragma once
#include "newton_search.cuh"

struct StartOfStep { real x[3], v[3], predictor[3], inertial_increment[3]; };  // of a node

// All is read before anything is written: a compiler leaves the order of reads and writes as it is, and each read is a trip.
__device__ __forceinline__ StartOfStep start_of_step(const NewtonArguments& p, int i) {
    StartOfStep s;
    for (int c = 0; c < 3; ++c) {
        const int k = 3 * i + c;
        s.x[c] = p.x[k];
        s.v[c] = p.v[k];
        s.predictor[c] = p.predictor[k];
        s.inertial_increment[c] = p.inertial_increment[k];
    }
    return s;
}

__device__ __forceinline__ void keep_start(const NewtonArguments& p, int i, const StartOfStep& s) {
    const long long n = 3ll * p.nodes;
    for (int c = 0; c < 3; ++c) {
        real* kept = p.initial_state + 3 * i + c;
        kept[0] = s.x[c];
        kept[n] = s.v[c];
        kept[2 * n] = s.predictor[c];
        kept[3 * n] = s.inertial_increment[c];
    }
}

__device__ __forceinline__ StartOfStep kept_start(const NewtonArguments& p, int i) {
    const long long n = 3ll * p.nodes;
    StartOfStep s;
    for (int c = 0; c < 3; ++c) {
        const real* kept = p.initial_state + 3 * i + c;
        s.x[c] = kept[0];
        s.v[c] = kept[n];
        s.predictor[c] = kept[2 * n];
        s.inertial_increment[c] = kept[3 * n];
    }
    return s;
}

// Of a range, by a warp: keeps the state, and sets increment = -predictor.
__device__ __forceinline__ void begin_range(const NewtonArguments& p, int range) {
    const NodeRange here = p.ranges[range];
    const int i = here.first + threadIdx.x % 32;
    double sum[2] = {0, 0};
    if (i < here.last) {
        const StartOfStep start = start_of_step(p, i);
        const int own = p.diagonal[i];
        const double mass = (double)p.mass[i];
        double b[3], a[9] = {};
        for (int c = 0; c < 3; ++c) b[c] = (double)p.b[3 * i + c];
        if (own >= 0)
            for (int c = 0; c < 9; c += 4) a[c] = (double)p.values[9ll * own + c];
        keep_start(p, i, start);
        for (int c = 0; c < 3; ++c) {
            p.increment[3 * i + c] = -(double)start.predictor[c];
            sum[0] += b[c] * b[c];
        }
        if (own >= 0) sum[1] = elastic_impulse_square(a, start.x, mass, p.dx_dv);
    }
    if (!sum_body(p, here, range, sum)) return;
    start_search(p.search[here.body], sqrt(sum[0]), EPSILON<local> * sqrt(sum[1]), p.bodies[here.body].kind);
#ifdef ERRORS
    if (p.bodies[here.body].position > 0) p.search[here.body].forcing = MOST_FORCING;
#endif
    p.phase[here.body] = SOLVE;
}

// In thread block `block` of another kernel, which has as many more.
__device__ __forceinline__ void begin_beside(const NewtonArguments& p, int block) {
    if (threadIdx.x < 32) begin_range(p, block);
}
