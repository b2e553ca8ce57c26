// SPDX-License-Identifier: MIT
// Order in which free thread blocks take the bodies of the pool (pcg.cu): those that took longest in the step before come first, so
// that no thread block is left with a long one at the end. Who solves a body when does not change its solution.
#pragma once
#include "block_group.cuh"

constexpr int COST_CLASSES = 128;

// Order of this step's pool, (pooled,).
__device__ __forceinline__ const int* pool_order(const PcgArguments& s, long long step) {
    return s.order + (step & 1) * s.count + s.count - s.pooled;
}

__device__ __forceinline__ int cost_of(const PcgArguments& s, int body, long long step) {
    const PcgResult& before = s.results[(step + s.capacity - 1) % s.capacity * s.count + body];
    return (min(before.iterations, 1000) + 2) * s.bodies[body].nodes;
}

// Sorts the pool for the next step, by the work of the step before this one. By the first thread block that finds the pool empty,
// while others still solve.
__device__ void sort_pool(const PcgArguments& s) {
    const long long step = s.step[0];
    const int *now = pool_order(s, step), lane = threadIdx.x;
    int* next = const_cast<int*>(pool_order(s, step + 1));
    unsigned *first = (unsigned*)shared_memory, *most = first + COST_CLASSES;
    unsigned largest = 1;
    for (int k = lane; k < s.pooled; k += THREADS) largest = max(largest, (unsigned)cost_of(s, now[k], step));
    most[lane] = largest;
    for (int k = lane; k < COST_CLASSES; k += THREADS) first[k] = 0;
    __syncthreads();
    if (lane == 0)
        for (int k = 1; k < THREADS; ++k) most[0] = max(most[0], most[k]);
    __syncthreads();
    const float scale = (COST_CLASSES - 1) / (float)most[0];
    auto class_of = [&](int body) { return COST_CLASSES - 1 - (int)(scale * cost_of(s, body, step)); };
    for (int k = lane; k < s.pooled; k += THREADS) atomicAdd(first + max(0, class_of(now[k])), 1);
    __syncthreads();
    if (lane == 0)
        for (unsigned k = 0, sum = 0; k < COST_CLASSES; ++k) {
            const unsigned count = first[k];
            first[k] = sum;
            sum += count;
        }
    __syncthreads();
    for (int k = lane; k < s.pooled; k += THREADS) next[atomicAdd(first + max(0, class_of(now[k])), 1)] = now[k];
}
