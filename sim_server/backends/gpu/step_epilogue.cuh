// SPDX-License-Identifier: MIT
// The end of a step: counts it, resets the counters of the next solve and the flags `moving`, and writes time stamps to the host.
#pragma once
#include "clock.cuh"

struct StepEpilogue {
    double* clock;              // (1,) time of the simulation [s]
    long long* step;            // (1,) number of completed steps
    double dt;                  // s
    unsigned* pool_counters;    // (counters,)
    unsigned* finished_blocks;  // (1,) zero between launches
    long long* timestamps;      // (capacity, 2) on the host: begin and end of each step [ns]; a step begins at the end of the one before,
                                // or at the time of `stamp_begin`
    long long* begun;           // (1,) as the timestamps: of the step under way
    int* moving;                // (bodies,)
    int counters, capacity, bodies;
};

// True in the thread block of a launch that finishes last.
__device__ __forceinline__ bool finishes_last(const StepEpilogue& t) {
    __shared__ bool last;
    __syncthreads();  // this thread block has done its items
    if (threadIdx.x == 0) {
        __threadfence();
        last = atomicAdd(t.finished_blocks, 1u) == gridDim.x - 1;
    }
    __syncthreads();
    return last;
}

// To be called by all threads of the thread block that finishes last.
__device__ __forceinline__ void end_step(const StepEpilogue& t) {
    const long long done = t.step[0], slot = done % t.capacity;
    for (int k = threadIdx.x; k < t.counters; k += blockDim.x) t.pool_counters[k] = 0;
    for (int k = threadIdx.x; k < t.bodies; k += blockDim.x) t.moving[k] = 0;
    __syncthreads();
    if (threadIdx.x == 0) {
        long long now = nanoseconds();
        t.timestamps[2 * slot + 1] = now;
        t.timestamps[2 * ((done + 1) % t.capacity)] = now;
        t.begun[0] = now;
        t.finished_blocks[0] = 0;
        t.step[0] = done + 1;
        t.clock[0] = (done + 1) * t.dt;
    }
}

// Writes the time at which the next step begins, where the device was idle before.
extern "C" __global__ void stamp_begin(const StepEpilogue t) {
    t.timestamps[2 * (t.step[0] % t.capacity)] = t.begun[0] = nanoseconds();
}
