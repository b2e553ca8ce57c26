// SPDX-License-Identifier: MIT
// The end of a step, done by whichever thread block of its last kernel finishes last: one more step is completed, the barriers
// of the next solve begin at zero, all bodies rest until their nodes say otherwise, and the results go to the host with the
// device's clock. kernel_fusion.py appends this to that kernel.
#include "clock.cuh"

struct Tick {
    double* clock;             // (1,) s of simulation
    long long* step;           // (1,) completed
    double dt;                 // s
    unsigned* arrived;         // (barriers,)
    unsigned* finished;        // (1,) thread blocks that have; zero between launches
    long long* stamps;         // (capacity, 2) on the host: ns when each step began and ended; a step begins when the one before
                               // has ended, or when `stamp` says so
    const long long* results;  // (capacity, words)
    long long* reports;        // likewise on the host
    int* moving;               // (bodies,)
    int barriers, capacity, words, bodies;
};

__device__ void tick(const Tick& t) {
    __shared__ bool last;
    __syncthreads();  // this thread block has done its items
    if (threadIdx.x == 0) {
        __threadfence();
        last = atomicAdd(t.finished, 1u) == gridDim.x - 1;
    }
    __syncthreads();
    if (!last) return;
    const long long done = t.step[0], slot = done % t.capacity;
    for (int k = threadIdx.x; k < t.words; k += blockDim.x) t.reports[slot * t.words + k] = t.results[slot * t.words + k];
    for (int k = threadIdx.x; k < t.barriers; k += blockDim.x) t.arrived[k] = 0;
    for (int k = threadIdx.x; k < t.bodies; k += blockDim.x) t.moving[k] = 0;
    __syncthreads();
    if (threadIdx.x == 0) {
        long long now = nanoseconds();
        t.stamps[2 * slot + 1] = now;
        t.stamps[2 * ((done + 1) % t.capacity)] = now;
        t.finished[0] = 0;
        t.step[0] = done + 1;
        t.clock[0] = (done + 1) * t.dt;
    }
}

// The device had nothing to do until now: the next step begins here.
extern "C" __global__ void stamp(const Tick t) { t.stamps[2 * (t.step[0] % t.capacity)] = nanoseconds(); }
