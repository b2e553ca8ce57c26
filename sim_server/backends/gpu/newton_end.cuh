// SPDX-License-Identifier: MIT
// The end of Newton-Raphson within a step on a GPU (newton.cu): it restores the state before the step, sets y so that `advance` arrives at the
// state found, and writes the results. It is done within the kernel that integrates, item by item (kernel_fusion.py), where nothing comes between.
#pragma once
#include "bounded_search.cuh"
#include "newton_begin.cuh"

__device__ __forceinline__ PcgResult& result_of(const NewtonArguments& p, int body) {
    return p.results[(p.step[0] % p.capacity) * p.count + body];
}

// Node i within the search, read at once.
struct SearchedNode {
    StartOfStep start;
    double increment[3], direction[3], beta;
};
__device__ __forceinline__ SearchedNode searched_node(const NewtonArguments& p, int i) {
    SearchedNode node = {kept_start(p, i), {}, {}, (double)p.beta[i]};
    for (int c = 0; c < 3; ++c) {
        node.increment[c] = p.increment[3 * i + c];
        node.direction[c] = p.direction[3 * i + c];
    }
    return node;
}

// Of node i of a body.
__device__ __forceinline__ void end_node(const NewtonArguments& p, int i, int body) {
    const Search& s = p.search[body];
    const SearchedNode node = searched_node(p, i);
    double increment[3], y[3];
    for (int c = 0; c < 3; ++c) increment[c] = increment_after(s, node.increment[c], node.direction[c]);
    rotate_node(p.rotation + 9ll * i, true, increment, y);
    for (int c = 0; c < 3; ++c) {
        const int k = 3 * i + c;
        p.x[k] = node.start.x[c];
        p.v[k] = node.start.v[c];
        p.predictor[k] = node.start.predictor[c];
        p.inertial_increment[k] = node.start.inertial_increment[c];
        p.y[k] = (real)y[c];
    }
}

// First node of a body whose b is not finite, -1: there is none. By a warp.
__device__ __forceinline__ int first_bad_node(const NewtonArguments& p, const PcgBody& body) {
    constexpr int NONE_FOUND = 0x7fffffff;
    int bad = NONE_FOUND;
    for (int k = threadIdx.x; k < body.nodes && bad == NONE_FOUND; k += 32) {
        const real* b = p.b + 3ll * (body.first + k);
        if (!(isfinite(b[0]) && isfinite(b[1]) && isfinite(b[2]))) bad = k;
    }
    for (int by = 16; by; by >>= 1) bad = min(bad, __shfl_xor_sync(WHOLE_WARP, bad, by));
    return bad == NONE_FOUND ? -1 : bad;
}

// The results of a body in the step. By a warp.
__device__ __forceinline__ void write_results(const NewtonArguments& p, int body) {
    const Search& s = p.search[body];
    const PcgBody& settings = p.bodies[body];
    const int bad = s.status == NOT_FINITE ? first_bad_node(p, settings) : -1;
    if (threadIdx.x) return;
    PcgResult& r = result_of(p, body);
    const bool used = settings.plan && (r.asked == CHOLESKY || s.kind == CHOLESKY || s.fallbacks);
    r.factor_step = used ? settings.factor_step : -1;
    r.residual = s.residual;
    r.seconds = s.seconds;
    r.iterations = s.iterations;
    r.status = s.status;
    r.kind = s.kind;
    r.fallbacks = s.fallbacks;
    r.bad_node = bad;
    r.at_rest = s.status == CONVERGED && s.iterations == 0 && s.residual > settings.tolerance;
    NewtonResult& told = p.newton_results[(p.step[0] % p.capacity) * p.count + body];
    told = {residual_ratio(s), s.linearizations > 1 ? s.linearizations : 1};
#ifdef ERRORS
    r.solve_error = as_told(s.solve_error);
    told.step_error = as_told(s.step_error);
#endif
}

// Once a step, by thread block `block` of `blocks`: the results of all bodies.
__device__ __forceinline__ void end_step_of_newton(const NewtonArguments& p, int block, int blocks) {
    if (block == 0 && threadIdx.x == 0) *p.active = p.count;  // of the next step
    if (threadIdx.x < 32)
        for (int body = block; body < p.count; body += blocks) write_results(p, body);
}

// Within another kernel: of item i, and of a thread block.
__device__ __forceinline__ void end_item(const NewtonArguments& p, int i) { end_node(p, i, p.body[i]); }
__device__ __forceinline__ void end_within(const NewtonArguments& p) { end_step_of_newton(p, blockIdx.x, gridDim.x); }
