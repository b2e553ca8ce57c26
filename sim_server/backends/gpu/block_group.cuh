// SPDX-License-Identifier: MIT
// Group of the thread blocks that solve one body: barrier, sums, shared memory. All sums have a fixed order.
#pragma once
#include "pcg_structs.cuh"

#ifndef THREADS
#define THREADS 512
#endif
#ifndef PER_PROCESSOR
#define PER_PROCESSOR 1
#endif
#define WARPS (THREADS / 32)
#define ALL 0xffffffffu
#ifndef AT_ONCE
#define AT_ONCE 5  // words that a thread loads at a time: 160 thread blocks, or 2560 entries of a vector, in one trip
#endif

#ifdef HELPED  // words are written and read by thread blocks of two devices (helper.cuh)
#define WORD_SCOPE "sys"
#else
#define WORD_SCOPE "gpu"
#endif

extern __shared__ __align__(16) char shared_memory[];

// Allocates shared memory, once per body. Null if it does not fit; global memory is used instead.
struct Arena {
    char* next;
    char* end;
    template <class T>
    __device__ __forceinline__ T* take(long long count) {
        long long bytes = (count * (long long)sizeof(T) + 15) / 16 * 16;
        if (bytes > end - next) return nullptr;
        T* found = (T*)next;
        next += bytes;
        return found;
    }
};

// Offset of an allocation of an arena. `shared_memory + offset` is compiled to loads from shared memory; a pointer kept in memory is not.
__device__ __forceinline__ int place_of(const void* taken) { return taken ? (int)((const char*)taken - shared_memory) : -1; }
template <class T>
__device__ __forceinline__ const T* shared_at(int place) { return (const T*)(shared_memory + place); }

__device__ __forceinline__ void copy_async(void* shared, const void* global, int bytes) {
    unsigned to = (unsigned)__cvta_generic_to_shared(shared);
    if (bytes == 16) asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(to), "l"(global) : "memory");
    else if (bytes == 8) asm volatile("cp.async.ca.shared.global [%0], [%1], 8;" ::"r"(to), "l"(global) : "memory");
    else asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(to), "l"(global) : "memory");
}
__device__ __forceinline__ void copies_begin() { asm volatile("cp.async.commit_group;" ::: "memory"); }
template <int LEFT>
__device__ __forceinline__ void copies_end() { asm volatile("cp.async.wait_group %0;" ::"n"(LEFT) : "memory"); }

// Thread blocks exchange values as words of 8 bytes: half a value (or half of a double), half the number of the exchange. A reader
// polls the word itself until it has the number. This needs no barrier and no fence, and one trip through L2 instead of four. A
// word is written and read atomically; no ordering between words is needed.
template <class T> struct FlagWord;
template <> struct FlagWord<float> {
    unsigned long long bits;
    __device__ __forceinline__ void put(float v, unsigned number) {
        const unsigned long long w = (unsigned long long)number << 32 | __float_as_uint(v);
        asm volatile("st.relaxed." WORD_SCOPE ".global.u64 [%0], %1;" ::"l"(this), "l"(w) : "memory");
    }
    __device__ __forceinline__ FlagWord<float> load() const {  // a copy of the word
        FlagWord<float> w;
        asm volatile("ld.relaxed." WORD_SCOPE ".global.u64 %0, [%1];" : "=l"(w.bits) : "l"(this));
        return w;
    }
    __device__ __forceinline__ bool unpack(float& v, unsigned number) const {
        v = __uint_as_float((unsigned)bits);
        return (unsigned)(bits >> 32) == number;
    }
    __device__ __forceinline__ bool get(float& v, unsigned number) const { return load().unpack(v, number); }
};
template <> struct __align__(16) FlagWord<double> {
    unsigned long long high, low;
    __device__ __forceinline__ void put(double v, unsigned number) {
        const unsigned long long bits = __double_as_longlong(v), tag = (unsigned long long)number << 32;
        asm volatile("st.relaxed." WORD_SCOPE ".global.v2.u64 [%0], {%1, %2};" ::"l"(this), "l"(tag | bits >> 32), "l"(tag | (bits & 0xffffffffull))
                     : "memory");
    }
    __device__ __forceinline__ FlagWord<double> load() const {
        FlagWord<double> w;
        asm volatile("ld.relaxed." WORD_SCOPE ".global.v2.u64 {%0, %1}, [%2];" : "=l"(w.high), "=l"(w.low) : "l"(this));
        return w;
    }
    __device__ __forceinline__ bool unpack(double& v, unsigned number) const {
        v = __longlong_as_double(high << 32 | (low & 0xffffffffull));
        return (unsigned)(high >> 32) == number && (unsigned)(low >> 32) == number;
    }
    __device__ __forceinline__ bool get(double& v, unsigned number) const { return load().unpack(v, number); }
};

// True if the word must be read again. After some minutes the launch fails instead of hanging the device, and the server reports
// that the device is lost.
__device__ __forceinline__ bool keep_polling(bool missing, unsigned& spins) {
    if (missing && ++spins > 1u << 27) __trap();
    return missing;
}

struct BlockGroup {
    int index, blocks;             // of this thread block; number of thread blocks in the group
    unsigned number;               // of the present exchange
    FlagWord<double>* block_sums;  // (2, 4, grid) of this body
    int grid;
    double (*scratch)[4];    // shared, 3 WARPS
    double* totals;  // shared, 4
    int lane, warp;
    FlagWord<double>* peak_words;  // (2, grid) of this body; null, as `peaks`, where no largest values are asked for
    double* peaks;                 // shared, WARPS + 1

    // Adds N <= 4 values over lanes 0 to LANES - 1 of all warps of the group; every thread gets the sums. Also a barrier.
    // fenced: writes to memory before it are visible to all after it.
    // PEAK: `peak`, of each thread, becomes the largest of the group; none is below 0.
    template <int N, int LANES, bool PEAK = false>
    __device__ __forceinline__ void sums(const double mine[N], double out[N], bool fenced = false, [[maybe_unused]] double* peak = nullptr) {
        if (lane < LANES)
            for (int n = 0; n < N; ++n) scratch[LANES * warp + lane][n] = mine[n];
        if constexpr (PEAK) keep_peak(*peak);
        ++number;
        __syncthreads();
        FlagWord<double>* row = block_sums + (number & 1) * 4 * grid;
        if (warp == 0) {
            double sum = 0;
            if (lane % 4 < N)
                for (int k = lane / 4; k < LANES * WARPS; k += 8) sum += scratch[k][lane % 4];
            for (int k = 16; k >= 4; k >>= 1) sum += __shfl_xor_sync(ALL, sum, k);
            if (blocks == 1 && lane < N) totals[lane] = sum;
            if (fenced) __threadfence();
            if (blocks > 1 && lane < N) row[lane * grid + index].put(sum, number);
            if constexpr (PEAK) put_peak();
        }
        if (blocks > 1)
            for (int n = warp; n < N; n += WARPS) {
                const double sum = read(row + n * grid);
                if (fenced) __threadfence();
                if (lane == 0) totals[n] = sum;
            }
        if constexpr (PEAK) read_peak(N % WARPS);
        __syncthreads();
        for (int n = 0; n < N; ++n) out[n] = totals[n];
        if constexpr (PEAK) *peak = total_peak();
    }

    __device__ __forceinline__ void barrier() {
        const double none[1] = {0};
        double sum[1];
        sums<1, 1>(none, sum, true);
    }

    // Sum of the words of all thread blocks, by one warp; each lane adds every 32nd. MOST: the largest one instead.
    template <bool MOST = false>
    __device__ __forceinline__ double read(const FlagWord<double>* row) const {
        double sum = 0;
        for (int first = lane; first < blocks + lane; first += 32 * AT_ONCE) {
            FlagWord<double> seen[AT_ONCE];
            double got[AT_ONCE];
            bool all;
            unsigned spins = 0;
            do {  // no branch between the loads, so that their latencies overlap
#pragma unroll
                for (int k = 0; k < AT_ONCE; ++k) seen[k] = row[min(first + 32 * k, blocks - 1)].load();
                all = true;
#pragma unroll
                for (int k = 0; k < AT_ONCE; ++k) all &= seen[k].unpack(got[k], number);
            } while (keep_polling(!all, spins));
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k)
                if constexpr (MOST) sum = first + 32 * k < blocks ? fmax(sum, got[k]) : sum;
                else sum += first + 32 * k < blocks ? got[k] : 0;
        }
        __syncwarp();
        for (int k = 16; k; k >>= 1) {
            const double other = __shfl_xor_sync(ALL, sum, k);
            sum = MOST ? fmax(sum, other) : sum + other;
        }
        return sum;
    }

    static __device__ __forceinline__ double most_of_warp(double mine) {
        for (int k = 16; k; k >>= 1) mine = fmax(mine, __shfl_xor_sync(ALL, mine, k));
        return mine;
    }
    __device__ __forceinline__ void keep_peak(double mine) const {
        mine = most_of_warp(mine);
        if (lane == 0) peaks[warp] = mine;
    }
    // By the first warp.
    __device__ __forceinline__ void put_peak() const {
        const double most = most_of_warp(lane < WARPS ? peaks[lane] : 0);
        if (lane == 0 && blocks == 1) peaks[WARPS] = most;
        if (lane == 0 && blocks > 1) peak_words[(number & 1) * grid + index].put(most, number);
    }
    __device__ __forceinline__ void read_peak(int reader) const {
        if (blocks == 1 || warp != reader) return;
        const double most = read<true>(peak_words + (number & 1) * grid);
        if (lane == 0) peaks[WARPS] = most;
    }
    __device__ __forceinline__ double total_peak() const { return peaks[WARPS]; }
};
