// SPDX-License-Identifier: MIT
// Work of a thread block on the correction of a factor (correction_state.cuh): slots for nodes, M, and what an application takes off.
// All thread blocks of a body choose slots alike, from the same numbers; the first one makes M.
#pragma once
#include "block_group.cuh"
#include "correction_state.cuh"

constexpr int MOST_COLUMNS = 3 * MOST_CORRECTED;
constexpr double LEAST_PIVOT = 1e-14;  // of the determinant of a pivot of I + U'V C

struct CorrectionMemory {        // shared memory of a thread block
    long long step;              // of the factor that V is for
    int used, usable;            // nodes of V; 1: M is there
    int node[MOST_CORRECTED];    // of the body, by slot
    int fresh[MOST_CORRECTED];   // slots whose columns are to be made
    int count, fresh_count;      // nodes with large differences; entries of `fresh`
    int place[MOST_CORRECTED];   // packed positions of the nodes
    int chosen[MOST_CORRECTED], sorted[MOST_CORRECTED];
    bool wanted[MOST_CORRECTED], there[MOST_CORRECTED];  // by slot; by place in `sorted`
    int changed;                 // 1: not the C that M was made with
    int ordered;                 // 1: M is positive definite with P
    float t[MOST_COLUMNS], s[MOST_COLUMNS];
};

// Gives slots to the nodes of a body with large differences, in the order of the nodes: those that they have, free ones, or those of nodes
// that have no large difference any more. share: of the body's nodes, as many as `capacity` of which are large at most.
__device__ __noinline__ void choose_slots(CorrectionMemory& m, const float* share, int nodes, int capacity) {
    const int me = threadIdx.x;
    if (me == 0) m.count = m.fresh_count = m.changed = 0;
    __syncthreads();
    for (int k = me; k < nodes; k += THREADS)
        if (__ldcg(share + k) >= (float)LEAST_SHARE) {
            const int at = atomicAdd(&m.count, 1);
            if (at < MOST_CORRECTED) m.chosen[at] = k;
        }
    __syncthreads();
    const int count = min(m.count, capacity);
    for (int k = me; k < count; k += THREADS) {
        int rank = 0;
        for (int j = 0; j < count; ++j) rank += m.chosen[j] < m.chosen[k];
        m.sorted[rank] = m.chosen[k];
    }
    __syncthreads();
    for (int k = me; k < MOST_CORRECTED; k += THREADS) {
        bool wanted = false, there = false;
        for (int j = 0; j < count && k < m.used; ++j) wanted |= m.sorted[j] == m.node[k];
        for (int j = 0; j < m.used && k < count; ++j) there |= m.sorted[k] == m.node[j];
        m.wanted[k] = wanted;
        m.there[k] = there;
    }
    __syncthreads();
    if (me == 0) {
        int slot = 0, used = m.used, fresh = 0;
        for (int k = 0; k < count; ++k) {
            if (m.there[k]) continue;
            int to = used;
            if (used < capacity) {
                ++used;
            } else {
                while (m.wanted[slot]) ++slot;
                to = slot++;
            }
            m.node[to] = m.sorted[k];
            m.fresh[fresh++] = to;
        }
        m.used = used;
        m.fresh_count = fresh;
    }
    __syncthreads();
}

// Entry `k % 6` of C of slot k / 6. share, difference: of the body's nodes.
__device__ __forceinline__ double entry_of(const CorrectionMemory& m, const float* share, const double* difference, int k) {
    const long long node = m.node[k / 6];
    return __ldcg(share + node) > 0 ? __ldcg(difference + 6 * node + k % 6) : 0;
}

// Sets `changed` if C is not what M was made with. block: CorrectedBody.
__device__ __noinline__ void compare_blocks(CorrectionMemory& m, const float* share, const double* difference, const double (*block)[6]) {
    for (int k = threadIdx.x; k < 6 * m.used; k += THREADS)
        if (entry_of(m, share, difference, k) != __ldcg(block[k / 6] + k % 6)) m.changed = 1;  // all write the same
    if (threadIdx.x == 0 && m.fresh_count) m.changed = 1;
    __syncthreads();
}

// Numbers of `scratch` that make_inner needs for so many nodes.
HOST_DEVICE long long scratch_size(int nodes) { return 9ll * nodes * nodes + 18ll * nodes; }

// M = C (I + S C)^-1 with S = U'V, by Gauss-Jordan elimination with pivots of 3x3: without exchanges of rows, as I + S C has
// eigenvalues from 1 on where something is added, and positive ones as long as the corrected inverse is positive definite. Sets
// `ordered` if the pivots are. Done by one thread block. columns: V of the body; a: `scratch`.
__device__ __noinline__ void make_inner(CorrectionMemory& m, const float* share, const double* difference, const float* columns, int width,
                                        double (*block)[6], float* inner, double* a) {
    const int n = 3 * m.used, me = threadIdx.x;
    double *row = a + (long long)n * n, *column = row + 3 * n;  // of a pivot: (3, n) and (n, 3)
    auto of_V = [&](int i, int j) { return (double)__ldcg(columns + (3ll * m.node[i / 3] + i % 3) * width + j); };
    for (int k = me; k < 6 * m.used; k += THREADS) block[k / 6][k % 6] = entry_of(m, share, difference, k);
    if (me == 0) m.ordered = 1;
    __syncthreads();
    for (int e = me; e < n * n; e += THREADS) {
        const int i = e / n, j = e % n, first = j - j % 3;
        double sum = i == j;
        for (int k = 0; k < 3; ++k) sum += 0.5 * (of_V(i, first + k) + of_V(first + k, i)) * block[j / 3][upper(k, j % 3)];
        a[e] = sum;
    }
    __syncthreads();
    for (int p = 0; p < n; p += 3) {
        double d[9], inverse[9];
        for (int k = 0; k < 9; ++k) d[k] = a[(long long)(p + k / 3) * n + p + k % 3];
        const double det = d[0] * (d[4] * d[8] - d[5] * d[7]) - d[1] * (d[3] * d[8] - d[5] * d[6]) + d[2] * (d[3] * d[7] - d[4] * d[6]);
        if (!(det > LEAST_PIVOT && det < 1e300)) {  // in all threads
            if (me == 0) m.ordered = 0;
            __syncthreads();
            return;
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const int b = (j + 1) % 3, c = (j + 2) % 3, q = (i + 1) % 3, r = (i + 2) % 3;
                inverse[3 * i + j] = (d[3 * b + q] * d[3 * c + r] - d[3 * b + r] * d[3 * c + q]) / det;
            }
        for (int j = me; j < n; j += THREADS)
            for (int k = 0; k < 3; ++k) {
                row[k * n + j] = inverse[3 * k] * a[(long long)p * n + j] + inverse[3 * k + 1] * a[(long long)(p + 1) * n + j] +
                                 inverse[3 * k + 2] * a[(long long)(p + 2) * n + j];
                column[3 * j + k] = a[(long long)j * n + p + k];
            }
        __syncthreads();
        for (int e = me; e < n * n; e += THREADS) {
            const int i = e / n, j = e % n;
            const bool in_row = i >= p && i < p + 3, in_column = j >= p && j < p + 3;
            const double* f = column + 3 * i;
            if (in_row) {
                a[e] = in_column ? inverse[3 * (i - p) + j - p] : row[(i - p) * n + j];
            } else if (in_column) {
                a[e] = -(f[0] * inverse[j - p] + f[1] * inverse[3 + j - p] + f[2] * inverse[6 + j - p]);
            } else {
                a[e] -= f[0] * row[j] + f[1] * row[n + j] + f[2] * row[2 * n + j];
            }
        }
        __syncthreads();
    }
    for (int e = me; e < n * width; e += THREADS) {
        const int i = e / width, j = e % width;
        double sum = 0;
        for (int k = 0; k < 3 && j < n; ++k) {
            sum += 0.5 * block[i / 3][upper(i % 3, k)] * a[(long long)(i - i % 3 + k) * n + j];
            sum += 0.5 * block[j / 3][upper(j % 3, k)] * a[(long long)(j - j % 3 + k) * n + i];
        }
        inner[e] = (float)sum;
    }
    __syncthreads();
}

// s = M t; returns t . s, in all threads. `t` is complete, for all threads.
__device__ __noinline__ double small_product(CorrectionMemory& m, const float* inner, int width) {
    const int n = 3 * m.used, lane = threadIdx.x % 32;
    for (int i = threadIdx.x / 32; i < n; i += WARPS) {
        float sum = 0;
        for (int j = lane; j < n; j += 32) sum += __ldcg(inner + (long long)i * width + j) * m.t[j];
        for (int k = 16; k; k >>= 1) sum += __shfl_xor_sync(ALL, sum, k);
        if (lane == 0) m.s[i] = sum;
    }
    if (threadIdx.x < 4 && n + (int)threadIdx.x < MOST_COLUMNS) m.s[n + threadIdx.x] = 0;  // read in fours
    __syncthreads();
    double product = 0;
    for (int j = lane; j < n; j += 32) product += (double)m.t[j] * m.s[j];
    for (int k = 16; k; k >>= 1) product += __shfl_xor_sync(ALL, product, k);
    return product;
}

// Entry of V s in a row of V.
__device__ __forceinline__ float taken_off(const CorrectionMemory& m, const float* row) {
    float sum = 0;
    for (int j = 0; j < 3 * m.used; j += 4) {
        const float4 v = __ldcg((const float4*)(row + j));
        sum += v.x * m.s[j] + v.y * m.s[j + 1] + v.z * m.s[j + 2] + v.w * m.s[j + 3];
    }
    return sum;
}
