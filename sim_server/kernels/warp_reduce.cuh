// SPDX-License-Identifier: MIT
// Sums over the threads of a warp, for backends/gpu/kernel_fusion.py. GPU only.
#pragma once
#include "kernel.h"

INLINE constexpr int padded(int n, int lanes) { return (n + lanes - 1) / lanes * lanes; }

// Sums SIZE values over LANES neighbouring threads into `row`: in each step a thread sends half of its values to its partner and
// adds the other half of the partner's, so that it ends with SIZE / LANES complete sums.
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
