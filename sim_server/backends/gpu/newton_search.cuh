// SPDX-License-Identifier: MIT
// Memory of Newton-Raphson on a GPU (newton.cu), and sums over the nodes of a body.
//
// A thread block, or a warp, has a range of a body's nodes; the last one of a body to finish adds the partial sums in a fixed order and makes
// the body's decision. Sums and the increment are double for every `real`.
#pragma once
#include "newton_line_search.cuh"
#include "pcg_structs.cuh"

#ifndef local
#define local real
#endif

constexpr int BLOCK_NODES = 32;  // of a range
constexpr int PARTS = 4;         // of a range, where each has a thread block of its own
#define WHOLE_WARP 0xffffffffu

struct NodeRange { int body, first, last, first_range, ranges, unused[3]; };  // nodes [first, last) of the scene; ranges of the body

struct NewtonArguments {
    const NodeRange* ranges;       // (grid,) by body
    double* partial_sums;          // (grid, PARTS, 2) sums of the ranges, or of their parts
    unsigned* finished_blocks;     // (bodies,) zero between launches
    Search* search;                // (bodies,)
    int* phase;                    // (bodies,) of each body's search, read by the other launches
    int* active;                   // (1,) bodies whose iteration is not over
    const PcgBody* bodies;
    const int* body;               // (nodes,) of the node
    PcgResult* results;            // (capacity, bodies) of the last solve; at the end of the step
    NewtonResult* newton_results;  // (capacity, bodies) on the host
    const long long* step;         // (1,) completed
    const long long* begun;        // (1,) time at which the step began [ns]
    TrialClock* clocks;            // (bodies,)
    unsigned* pool_counter;        // (1,) of the solver; set to zero before each of its launches
    const int* row_start;
    const int* columns;
    const int* diagonal;           // (nodes,) place of the node's own block, -1: fixed
    const real* values;            // (blocks, 3, 3)
    const real* b;                 // (nodes, 3) material frame
    real* y;                       // (nodes, 3) material frame: the solution; zero before the solves of corrections; for `advance`
    const local* rotation;         // (nodes, 3, 3)
    const real* mass;              // (nodes,) in A [kg]
    const real* beta;              // (nodes,) [s]
    real* x;                       // (nodes, 3) [m]
    real* v;                       // (nodes, 3) [m/s]
    real* predictor;               // likewise
    real* damping_velocity;
    real* inertial_increment;
    real* initial_state;           // (4, nodes, 3) x, v, predictor, inertial_increment before the step
    double* increment;             // (nodes, 3) [m/s]
    double* direction;             // (nodes, 3) [m/s]
    double dx_dv;                  // [s]
    double tolerance;
    int linearizations, trials, nodes, count, capacity, grid;
};

__device__ __forceinline__ void add_over_warp(double (&sum)[2]) {
    for (int k = 16; k; k >>= 1)
        for (int n = 0; n < 2; ++n) sum[n] += __shfl_xor_sync(WHOLE_WARP, sum[n], k);
}

// Sums over a body, of which this warp has part `mine` of all ranges' `parts` parts; true in the one lane that has the result, in the warp
// that finishes last.
__device__ __forceinline__ bool sum_body(const NewtonArguments& p, const NodeRange& here, int mine, double (&sum)[2], int parts = 1) {
    const int lane = threadIdx.x % 32;
    add_over_warp(sum);
    int last = 0;
    if (lane == 0) {
        for (int n = 0; n < 2; ++n) __stcg(p.partial_sums + 2 * mine + n, sum[n]);
        __threadfence();
        last = atomicAdd(p.finished_blocks + here.body, 1u) == (unsigned)(parts * here.ranges) - 1;
    }
    if (!__shfl_sync(WHOLE_WARP, last, 0)) return false;
    __threadfence();
    sum[0] = sum[1] = 0;
    for (int k = parts * here.first_range + lane, end = parts * (here.first_range + here.ranges); k < end; k += 32)
        for (int n = 0; n < 2; ++n) sum[n] += __ldcg(p.partial_sums + 2 * k + n);
    add_over_warp(sum);
    if (lane == 0) p.finished_blocks[here.body] = 0;
    return lane == 0;
}
