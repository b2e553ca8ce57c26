// SPDX-License-Identifier: MIT
// Rows of several reals, one a item. On a CPU they are read and written as they stand. On a GPU a thread that writes a row
// entry by entry leaves memory with pieces of pieces, so the threads of a warp write their rows together, through shared
// memory; and four entries are read at once.
#pragma once
#include "kernel.h"

#ifdef __CUDACC_RTC__

// Threads of this warp that have an item: the first so many.
INLINE int companions(int i, int n) {
    int lane = threadIdx.x & 31, most = BLOCK_ITEMS < 32 ? BLOCK_ITEMS : 32, left = n - (i - lane);
    return left < most ? left : most;
}

// Row i of `a` (n, K), for all items of a warp at once.
template <int K, class T>
INLINE void put_row(T* a, int i, int n, const T (&row)[K]) {
    constexpr int STRIDE = K | 1;  // odd: no two threads in one bank
    __shared__ T staged[(BLOCK_ITEMS + 31) / 32][32 * STRIDE];
    int lane = threadIdx.x & 31, count = companions(i, n);
    unsigned warp = count == 32 ? 0xffffffffu : (1u << count) - 1;
    T* mine = staged[threadIdx.x >> 5];
    __syncwarp(warp);
    for (int k = 0; k < K; ++k) mine[STRIDE * lane + k] = row[k];
    __syncwarp(warp);
    T* first = a + (long long)K * (i - lane);
    if (count == 32) {
#pragma unroll
        for (int t = 0; t < K; ++t) {
            int k = 32 * t + lane;
            first[k] = mine[STRIDE * (k / K) + k % K];
        }
    } else {
        for (int k = lane; k < K * count; k += count) first[k] = mine[STRIDE * (k / K) + k % K];
    }
}

// Nine entries from place 9 * `place` on, for all items of a warp at once.
template <class T>
INLINE void put_block(T* a, int place, int i, int n, const T (&row)[9]) {
    __shared__ T staged[(BLOCK_ITEMS + 31) / 32][32 * 9];
    __shared__ int places[(BLOCK_ITEMS + 31) / 32][32];
    int lane = threadIdx.x & 31, count = companions(i, n);
    unsigned warp = count == 32 ? 0xffffffffu : (1u << count) - 1;
    T* mine = staged[threadIdx.x >> 5];
    int* where = places[threadIdx.x >> 5];
    __syncwarp(warp);
    for (int k = 0; k < 9; ++k) mine[9 * lane + k] = row[k];
    where[lane] = place;
    __syncwarp(warp);
    if (count == 32) {
#pragma unroll
        for (int t = 0; t < 9; ++t) {
            int k = 32 * t + lane;
            a[9 * (long long)where[k / 9] + k % 9] = mine[k];
        }
    } else {
        for (int k = lane; k < 9 * count; k += count) a[9 * (long long)where[k / 9] + k % 9] = mine[k];
    }
}

INLINE void get_row(const float* a, int i, float (&row)[4]) {
    float4 v = ((const float4*)a)[i];
    row[0] = v.x; row[1] = v.y; row[2] = v.z; row[3] = v.w;
}
INLINE void get_row(const double* a, int i, double (&row)[4]) {
    double2 u = ((const double2*)a)[2 * i], v = ((const double2*)a)[2 * i + 1];
    row[0] = u.x; row[1] = u.y; row[2] = v.x; row[3] = v.y;
}
INLINE void get_row(const int* a, int i, int (&row)[4]) {
    int4 v = ((const int4*)a)[i];
    row[0] = v.x; row[1] = v.y; row[2] = v.z; row[3] = v.w;
}

#else

// Row after row: the entries of a row are neighbours in memory, those of a vector are not.
template <int K, class T, class N>
INLINE void put_row(T* a, index i, int, const N (&row)[K]) {
    alignas(64) T staged[K][LANES];
    for (int k = 0; k < K; ++k) __builtin_memcpy(staged[k], &row[k], sizeof(N));
    for (int l = 0; l < LANES; ++l) {
        T* mine = a + (long long)K * lane(i, l);
        for (int k = 0; k < K; ++k) mine[k] = staged[k][l];
    }
}
template <class T, class N>
INLINE void put_block(T* a, index place, index, int n, const N (&row)[9]) {
    put_row(a, place, n, row);
}
template <class T, class N>
INLINE void get_row(const T* a, index i, N (&row)[4]) {
    for (int k = 0; k < 4; ++k) row[k] = at(a, 4 * i + k);
}

#endif
