// SPDX-License-Identifier: MIT
// Thread blocks of CUDA, one after another, whose threads take turns on one thread of the processor, from barrier to barrier: enough
// for texts that sum over warps and blocks.
#pragma once
#undef _FORTIFY_SOURCE  // its longjmp refuses to go to another stack
#include <setjmp.h>
#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

#define __device__
#define __global__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)
#define __shared__ static
#define __align__(n) alignas(n)

using std::isfinite;

struct uint4 { unsigned x, y, z, w; };
struct Dimension { int x; };
static Dimension threadIdx, blockIdx, blockDim, gridDim;
static uint64_t exchanged[32][32];

struct Turn {                // of a thread
    ucontext_t start;
    jmp_buf here;  // where it goes on; a jump asks nothing of the system, as a swap of contexts does
    std::vector<char> stack;
    bool begun, ended;
};
static Turn turns[1024];
static int first_turn;       // of the thread block
static jmp_buf between_turns;

__attribute__((noinline)) static void give_turn() {
    if (!_setjmp(turns[first_turn + threadIdx.x].here)) _longjmp(between_turns, 1);
}
__attribute__((noinline)) static void take_turn(Turn& turn) {
    if (_setjmp(between_turns)) return;
    if (turn.begun) _longjmp(turn.here, 1);
    turn.begun = true;
    setcontext(&turn.start);
}

struct Barrier {
    int waiting = 0;
    unsigned passed = 0;
    void wait(int all) {
        const unsigned before = passed;
        if (++waiting == all) {
            waiting = 0;
            ++passed;
        }
        for (int k = 0; passed == before; ++k) {
            if (k > 100000) { std::fprintf(stderr, "a barrier waits for a thread that has ended\n"); std::abort(); }
            give_turn();
        }
    }
};
static Barrier block_barrier, warp_barrier[32];

static void __syncthreads() { block_barrier.wait(blockDim.x); }
static double __longlong_as_double(long long bits) {
    double a;
    std::memcpy(&a, &bits, sizeof a);
    return a;
}

static void __threadfence() { __atomic_thread_fence(__ATOMIC_SEQ_CST); }
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
    warp_barrier[warp].wait(32);
    bits = exchanged[warp][from < 0 || from > 31 ? lane : from];
    warp_barrier[warp].wait(32);
    std::memcpy(&value, &bits, sizeof value);
    return value;
}
template <class T> static T __shfl_sync(unsigned, T a, int lane) { return exchange(a, lane); }
static unsigned __ballot_sync(unsigned, bool holds) {
    const int warp = threadIdx.x / 32;
    exchanged[warp][threadIdx.x % 32] = holds;
    warp_barrier[warp].wait(32);
    unsigned all = 0;
    for (int lane = 0; lane < 32; ++lane) all |= (unsigned)exchanged[warp][lane] << lane;
    warp_barrier[warp].wait(32);
    return all;
}
static int __popc(unsigned a) { return __builtin_popcount(a); }
static int __ffs(unsigned a) { return __builtin_ffs((int)a); }
template <class T> static T __shfl_xor_sync(unsigned, T a, int by) { return exchange(a, (threadIdx.x % 32) ^ by); }

static void __syncwarp() { warp_barrier[threadIdx.x / 32].wait(32); }

// Whether it holds in all threads of the thread block.
static bool __syncthreads_and(bool holds) {
    static int others = 0;
    if (!holds) others = 1;
    __syncthreads();
    const bool all = others == 0;
    __syncthreads();
    if (threadIdx.x == 0) others = 0;
    __syncthreads();
    return all;
}

static void (*run_kernel)(void*);
static void* kernel_run;

static void take_turns() {
    run_kernel(kernel_run);
    turns[first_turn + threadIdx.x].ended = true;
    give_turn();
}

static void begin_turn(int t) {
    Turn& turn = turns[t];
    turn.stack.resize(1 << 18);
    turn.begun = turn.ended = false;
    getcontext(&turn.start);
    turn.start.uc_stack.ss_sp = turn.stack.data();
    turn.start.uc_stack.ss_size = turn.stack.size();
    makecontext(&turn.start, take_turns, 0);
}

// Thread blocks that wait for each other: all of them take turns. shared: what `__shared__` stands before, which each block has by itself.
struct Region { void* begin; size_t bytes; };
template <class Kernel> static void launch_together(int blocks, int threads, Kernel kernel, std::vector<Region> shared) {
    shared.insert(shared.end(), {{&block_barrier, sizeof block_barrier}, {warp_barrier, sizeof warp_barrier}, {exchanged, sizeof exchanged}});
    std::vector<std::vector<char>> kept(blocks * shared.size());
    auto each = [&](int block, auto f) {
        for (size_t k = 0; k < shared.size(); ++k) f((char*)shared[k].begin, shared[k].bytes, kept[block * shared.size() + k]);
    };
    blockDim.x = threads;
    gridDim.x = blocks;
    run_kernel = [](void* k) { (*(Kernel*)k)(); };
    kernel_run = &kernel;
    for (int b = 0; b < blocks; ++b) each(b, [](char* from, size_t bytes, auto& to) { to.assign(from, from + bytes); });
    for (int t = 0; t < blocks * threads; ++t) begin_turn(t);
    for (int left = 1, first = 0; left > 0; first = (first + 1) % blocks) {
        left = 0;
        for (int k = 0; k < blocks; ++k) {
            blockIdx.x = (first + k) % blocks;
            first_turn = blockIdx.x * threads;
            each(blockIdx.x, [](char* to, size_t bytes, auto& from) { std::memcpy(to, from.data(), bytes); });
            for (int t = 0; t < threads; ++t) {
                if (turns[first_turn + t].ended) continue;
                threadIdx.x = t;
                take_turn(turns[first_turn + t]);
                left += !turns[first_turn + t].ended;
            }
            each(blockIdx.x, [](char* from, size_t bytes, auto& to) { std::memcpy(to.data(), from, bytes); });
        }
    }
    first_turn = 0;
}

template <class Kernel> static void launch(int blocks, int threads, Kernel kernel) {
    blockDim.x = threads;
    gridDim.x = blocks;
    run_kernel = [](void* k) { (*(Kernel*)k)(); };
    kernel_run = &kernel;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) {
        for (int t = 0; t < threads; ++t) begin_turn(t);
        for (int left = threads; left > 0;) {
            left = 0;
            for (int t = 0; t < threads; ++t) {
                if (turns[t].ended) continue;
                threadIdx.x = t;
                take_turn(turns[t]);
                left += !turns[t].ended;
            }
        }
    }
}
