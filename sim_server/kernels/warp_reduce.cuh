// SPDX-License-Identifier: MIT
// What backends/gpu/kernel_fusion.py needs of the threads of a warp. GPU only.
#pragma once
#include "kernel.h"

INLINE constexpr int padded(int n, int lanes) { return (n + lanes - 1) / lanes * lanes; }

// The sums of SIZE values over LANES neighbouring threads, written to `row`: each step hands half of the values to the
// partner and takes the partner's share of the other half, so that every thread ends with SIZE / LANES whole sums.
template <int SIZE, int LANES>
INLINE void share_sum(local (&sum)[SIZE], int lane, local* row) {
    int count = SIZE;
#pragma unroll
    for (int step = LANES / 2; step; step >>= 1) {
        count /= 2;
        bool upper = lane & step;
#pragma unroll
        for (int m = 0; m < SIZE / 2; ++m) {
            if (m >= count) break;
            local keep = upper ? sum[m + count] : sum[m], give = upper ? sum[m] : sum[m + count];
            sum[m] = keep + __shfl_xor_sync(0xffffffffu, give, step);
        }
    }
#pragma unroll
    for (int m = 0; m < SIZE / LANES; ++m) row[SIZE / LANES * lane + m] = sum[m];
}

// Where `value` is in the ascending (n,) list, or -1.
INLINE int place(const int* list, int n, int value) {
    int first = 0;
    for (int count = n; count > 0;) {
        int half = count / 2;
        bool below = list[first + half] < value;
        first = below ? first + half + 1 : first;
        count = below ? count - half - 1 : half;
    }
    return first < n && list[first] == value ? first : -1;
}
