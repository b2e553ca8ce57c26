// SPDX-License-Identifier: MIT
// Work of a thread block on the local refresh of a factor (refresh_state.cuh): T, A on T, its inverse S, and what S makes of a vector.
// All thread blocks of a body choose T alike, from the same numbers; those that have its rows write A, the first one makes S.
#pragma once
#include "pivots3.cuh"
#include "refresh_state.cuh"
#include "spmv.cuh"

struct RefreshMemory {               // shared memory of a thread block
    int used;                        // nodes of T, 0: there is no refresh
    int node[MOST_REFRESHED];        // of the body, ascending: by slot
    int pairs;                       // nodes of T that are in the halo
    int entry[MOST_REFRESHED], slot[MOST_REFRESHED];  // of each of these, in any order: the own nodes are those with small entries
    int count, level, above[CHANGED_LEVELS];
    float t[REFRESHED_FREEDOMS], s[REFRESHED_FREEDOMS];  // by slot; by pair
};

// a^N. Compared instead of logarithms, which would take registers.
template <int N>
__device__ __forceinline__ double power(double a) {
    double product = 1;
    for (int k = 0; k < N; ++k) product *= a;
    return product;
}

// Entry of a block that is the i-th of its upper triangle.
__device__ __forceinline__ int entry_of_upper(int i) { return i < 3 ? i : i < 5 ? i + 1 : 8; }

// Levels of change that a score is above, 0 if it is ignored.
__device__ __forceinline__ int level_of(float score) {
    int level = 0;
    for (double least = CHANGED; level < CHANGED_LEVELS && score > least; least *= CHANGED_STEP) ++level;
    return level;
}

// Finds T: the nodes that have changed most. score: of the body's nodes.
__device__ __noinline__ void choose_refreshed(RefreshMemory& m, const float* score, int nodes) {
    const int me = threadIdx.x;
    if (me < CHANGED_LEVELS) m.above[me] = 0;
    if (me == 0) m.count = 0;
    __syncthreads();
    for (int k = me; k < nodes; k += THREADS)
        if (const int level = level_of(__ldcg(score + k))) atomicAdd(&m.above[level - 1], 1);
    __syncthreads();
    if (me == 0) {
        m.level = CHANGED_LEVELS + 1;  // none
        for (int level = CHANGED_LEVELS, above = 0; level > 0; --level) {
            above += m.above[level - 1];
            if (above > MOST_REFRESHED) break;
            m.level = level;
        }
    }
    __syncthreads();
    for (int k = me; k < nodes; k += THREADS)
        if (level_of(__ldcg(score + k)) >= m.level) m.entry[atomicAdd(&m.count, 1)] = k;
    __syncthreads();
    const int count = m.count;
    for (int k = me; k < count; k += THREADS) {
        int rank = 0;
        for (int j = 0; j < count; ++j) rank += m.entry[j] < m.entry[k];
        m.node[rank] = m.entry[k];
    }
    if (me == 0) { m.used = count; m.pairs = 0; }
    __syncthreads();
}

// Finds the nodes of T in the halo.
__device__ __noinline__ void find_pairs(RefreshMemory& m, const BlockRows& rows) {
    for (int k = threadIdx.x; k < rows.halo; k += THREADS) {
        const int node = rows.nodes[k];
        int low = 0, high = m.used;
        while (low < high) {
            const int middle = (low + high) / 2;
            if (m.node[middle] < node) low = middle + 1;
            else high = middle;
        }
        if (low == m.used || m.node[low] != node) continue;
        const int at = atomicAdd(&m.pairs, 1);
        m.entry[at] = k;
        m.slot[at] = low;
    }
    __syncthreads();
}

// Writes the own rows of A on T. a: (3 used, 3 used)
__device__ __noinline__ void write_rows(const RefreshMemory& m, const BlockRows& rows, double* a) {
    const int lane = threadIdx.x % 32, n = 3 * m.used;
    for (int p = threadIdx.x / 32; p < m.pairs; p += WARPS) {
        const int own = m.entry[p];
        if (own >= rows.own) continue;
        double* to = a + 3ll * m.slot[p] * n;
        for (int k = lane; k < 3 * n; k += 32) __stcg(to + k, 0.0);
        __syncwarp();
        for (int k = rows.row_start[own] - rows.base + lane; k < rows.row_start[own + 1] - rows.base; k += 32)
            for (int other = 0; other < m.pairs; ++other)
                if (m.entry[other] == rows.columns[k])
                    for (int i = 0; i < 9; ++i) __stcg(to + i / 3 * n + 3 * m.slot[other] + i % 3, (double)rows.blocks[9ll * k + i]);
    }
}

// S of A on T, by one thread block; false if A is not positive there. a: A; room: of this thread block, as large, or null.
__device__ __noinline__ bool make_local_inverse(int n, double* a, double* room, float* inner) {
    double* const work = room ? room : a;
    if (room)
        for (int k = threadIdx.x; k < n * n; k += THREADS) work[k] = __ldcg(a + k);
    __syncthreads();
    double* row = work + n * n;
    const bool made = invert_by_pivots(work, n, row, row + 3 * n, 0.0);
    for (int i = threadIdx.x / 32; made && i < n; i += WARPS)
        for (int j = threadIdx.x % 32; j < n; j += 32) __stcg(inner + i * REFRESHED_FREEDOMS + j, (float)(0.5 * (work[i * n + j] + work[j * n + i])));
    __syncthreads();
    return made;
}

// s = S t at the nodes of the halo, by pair; t is complete.
__device__ __noinline__ void apply_local_inverse(RefreshMemory& m, const float* inner) {
    const int n = 3 * m.used, lane = threadIdx.x % 32;
    for (int row = threadIdx.x / 32; row < 3 * m.pairs; row += WARPS) {
        const float* of = inner + (3 * m.slot[row / 3] + row % 3) * REFRESHED_FREEDOMS;
        float sum = 0;
        for (int j = lane; j < n; j += 32) sum += __ldcg(of + j) * m.t[j];
        for (int k = 16; k; k >>= 1) sum += __shfl_xor_sync(ALL, sum, k);
        if (lane == 0) m.s[row] = sum;
    }
    __syncthreads();
}
