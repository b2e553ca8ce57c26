// SPDX-License-Identifier: MIT
// Epilogue of the last kernel of an attempt (stages.cuh): the largest estimate of each body, and the decision whether the attempt is
// its step. Once every body's step is made the step ends (step_epilogue.cuh), else the next branch of the graph runs.
#include "stages.cuh"
#include "step_epilogue.cuh"

#ifndef BLOCK_ITEMS
#define BLOCK_ITEMS 128  // where this text is compiled alone
#endif

struct StageDecision {
    StepEpilogue end;
    StageState* state;             // (bodies,)
    int* phase;                    // (bodies,)
    long long* largest;            // (bodies,) bits of the largest estimate; zero between attempts
    const double* bound;           // (bodies,) [m]
    const PcgBody* rows;           // (bodies,)
    const real* estimate;          // (nodes,) [m]
    const int* body;               // (nodes,) of the node
    StageResult* results;          // (capacity, bodies) on the host
    int* left;                     // (1,) out: bodies that make another attempt
    int attempt, nodes;            // attempt: StepForm
};

// The largest estimate, whatever the order: the bits of numbers from 0 on ascend with them, and those of NaN are above all.
__device__ __forceinline__ void note_estimates(const StageDecision& t) {
    const int i = blockIdx.x * BLOCK_ITEMS + threadIdx.x, first = t.body[min(blockIdx.x * BLOCK_ITEMS, t.nodes - 1)];
    const bool here = threadIdx.x < BLOCK_ITEMS && i < t.nodes;
    const int body = here ? t.body[i] : first;
    long long bits = here && t.phase[body] == OPEN ? __double_as_longlong((double)t.estimate[i]) & 0x7fffffffffffffffll : 0;
    if (!__syncthreads_and(body == first)) {
        if (bits) atomicMax(t.largest + body, bits);
        return;
    }
    for (int k = 16; k; k >>= 1) {
        const long long other = __shfl_xor_sync(0xffffffffu, bits, k);
        bits = other > bits ? other : bits;
    }
    if (threadIdx.x % 32 == 0 && bits) atomicMax(t.largest + body, bits);
}

__device__ void decide(const StageDecision& t) {
    __shared__ int left;
    if (t.attempt != EULER) note_estimates(t);
    if (threadIdx.x == 0) left = 0;
    if (!finishes_last(t.end)) return;
    __threadfence();
    const long long step = t.end.step[0], slot = step % t.end.capacity * t.end.bodies;
    for (int k = threadIdx.x; k < t.end.bodies; k += blockDim.x) {
        if (t.phase[k] != OPEN) continue;
        StageState s = t.state[k];
        const double estimate = __longlong_as_double(__ldcg(t.largest + k));
        t.largest[k] = 0;
        if (judge(s, t.rows[k], t.attempt, estimate, t.bound[k], t.end.moving[k] != 0, step)) {
            t.results[slot + k] = {s.estimate, s.inconsistency, s.form};
            t.phase[k] = MADE;
        } else {
            atomicAdd(&left, 1);
        }
        t.state[k] = s;
    }
    __syncthreads();
    const int others = left;
    if (threadIdx.x == 0) {
        *t.left = others;
        t.end.finished_blocks[0] = 0;
    }
    if (others) return;
    for (int k = threadIdx.x; k < t.end.bodies; k += blockDim.x) {
        t.phase[k] = OPEN;
        t.state[k].form = ITERATE;
    }
    end_step(t.end);
}
