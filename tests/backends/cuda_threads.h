// SPDX-License-Identifier: MIT
// Thread blocks of CUDA as threads of the processor, one block after another: enough for texts that sum over warps and blocks.
#pragma once
#include <pthread.h>

#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <thread>
#include <vector>

#define __device__
#define __global__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(n)
#define __shared__ static
#define __align__(n) alignas(n)

using std::isfinite;

struct uint4 { unsigned x, y, z, w; };
struct Dimension { int x; };
static thread_local Dimension threadIdx;
static Dimension blockIdx, blockDim, gridDim;
static pthread_barrier_t block_barrier, warp_barrier[32];
static uint64_t exchanged[32][32];

static void __syncthreads() { pthread_barrier_wait(&block_barrier); }
static double __longlong_as_double(long long bits) {
    double a;
    std::memcpy(&a, &bits, sizeof a);
    return a;
}

static void __threadfence() { std::atomic_thread_fence(std::memory_order_seq_cst); }
template <class T> static T atomicAdd(T* a, T by) { return __atomic_fetch_add(a, by, __ATOMIC_SEQ_CST); }
template <class T> static T atomicSub(T* a, T by) { return __atomic_fetch_sub(a, by, __ATOMIC_SEQ_CST); }
template <class T> static T __ldcg(const T* a) {
    T found;
    __atomic_load(const_cast<T*>(a), &found, __ATOMIC_SEQ_CST);
    return found;
}
template <class T> static void __stcg(T* a, T value) { __atomic_store(a, &value, __ATOMIC_SEQ_CST); }
static void atomicMax(long long* a, long long b) {
    long long seen = __ldcg(a);
    while (seen < b && !__atomic_compare_exchange_n(a, &seen, b, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST)) {}
}
static void atomicMin(int* a, int b) {
    int seen = __ldcg(a);
    while (seen > b && !__atomic_compare_exchange_n(a, &seen, b, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST)) {}
}
static int min(int a, int b) { return a < b ? a : b; }
static long long __double_as_longlong(double a) {
    long long bits;
    std::memcpy(&bits, &a, sizeof bits);
    return bits;
}

// The value of another lane of the warp; all of them come here.
template <class T> static T exchange(T value, int from) {
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof value);
    exchanged[warp][lane] = bits;
    pthread_barrier_wait(&warp_barrier[warp]);
    bits = exchanged[warp][from < 0 || from > 31 ? lane : from];
    pthread_barrier_wait(&warp_barrier[warp]);
    std::memcpy(&value, &bits, sizeof value);
    return value;
}
template <class T> static T __shfl_xor_sync(unsigned, T a, int by) { return exchange(a, (threadIdx.x % 32) ^ by); }

// Whether it holds in all threads of the thread block.
static bool __syncthreads_and(bool holds) {
    static std::atomic<int> others{0};
    if (!holds) others = 1;
    __syncthreads();
    const bool all = others == 0;
    __syncthreads();
    if (threadIdx.x == 0) others = 0;
    __syncthreads();
    return all;
}

template <class Kernel> static void launch(int blocks, int threads, Kernel kernel) {
    blockDim.x = threads;
    gridDim.x = blocks;
    pthread_barrier_init(&block_barrier, nullptr, threads);
    for (int w = 0; w < threads / 32; ++w) pthread_barrier_init(&warp_barrier[w], nullptr, 32);
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) {
        std::vector<std::thread> all;
        for (int t = 0; t < threads; ++t)
            all.emplace_back([&, t] {
                threadIdx.x = t;
                kernel();
            });
        for (std::thread& one : all) one.join();
    }
}
