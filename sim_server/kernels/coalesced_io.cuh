// SPDX-License-Identifier: MIT
// Reads and writes rows of several reals, one row per item. On a GPU a thread that wrote its row entry by entry would make
// uncoalesced accesses, so the threads of a warp write their rows together, through shared memory, and read four entries at
// once. On a CPU rows are read and written directly.
#pragma once
#include "kernel.h"

#ifdef __CUDACC_RTC__

// Rows of each warp on their way, of any of its arrays: less shared memory than one for each leaves room for more thread blocks and for the cache.
__shared__ double staging[(BLOCK_ITEMS + 31) / 32][32 * 17];

template <class T, int N> INLINE T* staged_rows() {
    if constexpr (N * sizeof(T) <= sizeof staging[0]) return (T*)staging[threadIdx.x >> 5];
    else {
        __shared__ T large[(BLOCK_ITEMS + 31) / 32][N];
        return large[threadIdx.x >> 5];
    }
}

// Number of threads of this warp that have an item; they are the first ones.
INLINE int companions(int i, int n) {
    int lane = threadIdx.x & 31, most = BLOCK_ITEMS < 32 ? BLOCK_ITEMS : 32, left = n - (i - lane);
    return left < most ? left : most;
}

// Row i of `a` (n, K), for all items of a warp at once.
template <int K, class T>
INLINE void put_row(T* a, int i, int n, const T (&row)[K]) {
    constexpr int STRIDE = K | 1;  // odd: no two threads in one bank
    int lane = threadIdx.x & 31, count = companions(i, n);
    unsigned warp = count == 32 ? 0xffffffffu : (1u << count) - 1;
    T* mine = staged_rows<T, 32 * STRIDE>();
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
    __syncwarp(warp);  // what another thread has written of its row is there
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

INLINE void get_item_row(const int* a, int i, int (&row)[4]) { get_row(a, i, row); }

#else

#if defined(WIDE) && defined(__GNUC__) && !defined(__clang__)
// a and b exchange blocks of LEAP entries: a stage of a transposition.
template <int LEAP> INLINE void exchange(number& a, number& b) {
    decltype(a < b) first = {}, second = {};
    for (int k = 0; k < LANES; ++k) {
        first[k] = k & LEAP ? k - LEAP + LANES : k;
        second[k] = k & LEAP ? k + LANES : k + LEAP;
    }
    number x = a;
    a = __builtin_shuffle(x, b, first);
    b = __builtin_shuffle(x, b, second);
}
template <int LEAP = LANES / 2> INLINE void transpose(number (&v)[LANES]) {
    UNROLL for (int k = 0; k < LANES; ++k)
        if ((k & LEAP) == 0) exchange<LEAP>(v[k], v[k + LEAP]);
    if constexpr (LEAP > 1) transpose<LEAP / 2>(v);
}
// Entries from FIRST on, as many as lanes, row after row: transposed in registers.
template <int FIRST, int K> INLINE int put_wide(real* a, const long long (&place)[LANES], const number (&row)[K]) {
    if constexpr (FIRST + LANES > K) return FIRST;
    else {
        number v[LANES];
        UNROLL for (int k = 0; k < LANES; ++k) v[k] = row[FIRST + k];
        transpose(v);
        UNROLL for (int l = 0; l < LANES; ++l) __builtin_memcpy(a + place[l] + FIRST, &v[l], sizeof(number));
        return put_wide<FIRST + LANES>(a, place, row);
    }
}
#else
template <int FIRST, class T, class P, class N, int K> INLINE int put_wide(T*, const P&, const N (&)[K]) { return 0; }
#endif

// Row after row: the entries of a row are neighbours in memory, those of a vector are not.
template <int K, class T, class N>
INLINE void put_row(T* a, index i, int, const N (&row)[K]) {
    if constexpr (K < 4) {
        for (int k = 0; k < K; ++k) put(a, K * i + k, row[k]);
        return;
    }
    long long place[LANES];
    UNROLL for (int l = 0; l < LANES; ++l) place[l] = (long long)K * lane(i, l);
    const int done = put_wide<0>(a, place, row);
    if (done == K) return;
    alignas(64) T staged[K][LANES];
    for (int k = done; k < K; ++k) __builtin_memcpy(staged[k], &row[k], sizeof(N));
    UNROLL for (int l = 0; l < LANES; ++l)
        for (int k = done; k < K; ++k) a[place[l] + k] = staged[k][l];
}
template <class T, class N>
INLINE void put_block(T* a, index place, index, int n, const N (&row)[9]) {
    put_row(a, place, n, row);
}
template <class T, class N>
INLINE void get_row(const T* a, index i, N (&row)[4]) {
    for (int k = 0; k < 4; ++k) row[k] = at(a, 4 * i + k);
}
// Those of the items of the kernel: neighbours in memory.
INLINE void get_item_row(const int* a, index i, index (&row)[4]) {
#if defined(WIDE) && defined(__GNUC__) && !defined(__clang__)
    if (i[LANES - 1] - i[0] == LANES - 1) {
        index v[4], even = {}, odd = {}, low = {}, high = {};
        __builtin_memcpy(v, a + 4 * (long long)i[0], sizeof v);
        for (int k = 0; k < LANES; ++k) {
            const int half = LANES / 2, second = k >= half;
            even[k] = 4 * (k - second * half) + second;
            odd[k] = even[k] + 2;
            low[k] = second ? k + half : k;
            high[k] = low[k] + half;
        }
        UNROLL for (int k = 0; k < 4; k += 2) {
            index first = __builtin_shuffle(v[0], v[1], k ? odd : even), last = __builtin_shuffle(v[2], v[3], k ? odd : even);
            row[k] = __builtin_shuffle(first, last, low);
            row[k + 1] = __builtin_shuffle(first, last, high);
        }
        return;
    }
#endif
    get_row(a, i, row);
}

#endif
