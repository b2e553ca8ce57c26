// SPDX-License-Identifier: MIT
// The rows of A that a thread block has, with the vectors that are its own. A block keeps the values of every node that its
// rows read ("halo", its own nodes first), so that a search direction is formed where it is used and never sent.
#pragma once
#include "team.cuh"
#include "invert3.cuh"

#define TOGETHER 3  // rows of a warp at a time

struct Rows {
    int begin, own, halo;           // own nodes [begin, begin + own) of the body; nodes read
    const int* nodes;               // (halo,) of the body
    real* values;                   // (halo, 3) of the vector that A multiplies
    int* place;                     // (halo,) where the next one is read
    real *x, *r, *q;                // (own, 3)
    const int* row_start;           // (own + 1,), less `base`
    const int* columns;             // places in halo
    const real* blocks;
    int base;
    bool near;                      // A is in shared memory

    __device__ __forceinline__ void set_up(const Solve& s, const Body& body, const Share& share, Arena& arena) {
        begin = share.begin; own = share.own; halo = share.halo;
        nodes = s.halo + share.halo_first;
        values = arena.take<real>(3 * halo);
        if (!values) values = s.halo_values + 3ll * share.halo_first;
        place = arena.take<int>(halo);
        if (!place) place = s.halo_place + share.halo_first;
        int* list = arena.take<int>(halo);
        if (list) {
            for (int k = threadIdx.x; k < halo; k += THREADS) copy_async(list + k, nodes + k, 4);
            nodes = list;
        }
        long long row = body.first + begin, all = 3ll * s.nodes;
        x = arena.take<real>(9 * own);
        long long step = x ? 3 * own : all;
        if (!x) x = s.own + 3 * row;
        r = x + step;
        q = r + step;
        bring(s, (int)row, share, arena);
    }

    // Copies the own rows of A into shared memory if they fit: loads after a barrier miss L1.
    __device__ __forceinline__ void bring(const Solve& s, int row, const Share& share, Arena& arena) {
        const int count = share.blocks;
        base = share.block_first;
        row_start = s.row_start + row;
        columns = s.seat + base;
        blocks = s.values + 9ll * base;
        Arena before = arena;
        real* v = arena.take<real>(9 * count);
        int *c = arena.take<int>(count), *start = arena.take<int>(own + 1);
        near = v && c && start;
        if (near) {
            for (int k = threadIdx.x; k < 9 * count; k += THREADS) copy_async(v + k, blocks + k, sizeof(real));
            for (int k = threadIdx.x; k < count; k += THREADS) copy_async(c + k, columns + k, 4);
            for (int k = threadIdx.x; k <= own; k += THREADS) copy_async(start + k, row_start + k, 4);
            blocks = v; columns = c; row_start = start;
        } else {
            arena = before;
        }
        copies_begin();
    }

    // q = A values for the own nodes. done(node, q): called by lanes 0, 1, 2 with entry `lane` of q.
    template <class Done>
    __device__ __forceinline__ void multiply(Done done) const {
        if (own <= WARPS) some_rows<1>(done);
        else some_rows<TOGETHER>(done);
    }

    template <int N, class Done>
    __device__ __forceinline__ void some_rows(Done done) const {
        const int lane = threadIdx.x % 32;
        for (int first = threadIdx.x / 32; first < own; first += N * WARPS) {
            real sum[N];
            if (near) of_near<N>(first, sum);
            else of_far<N>(first, sum);
#pragma unroll
            for (int n = 0; n < N; ++n)
                if (lane < 3 && first + n * WARPS < own) done(first + n * WARPS, sum[n]);
        }
    }

    // Eight blocks of a row at a time: lane 3 e + r has row r of block e. The sums end in lanes 0, 1, 2. Rows of up to 16 blocks
    // go without a branch, so that the warp's rows overlap.
    template <int N>
    __device__ __forceinline__ void of_near(int first, real sum[N]) const {
        const int lane = threadIdx.x % 32, entry = lane / 3, r = lane - 3 * entry;
#pragma unroll
        for (int n = 0; n < N; ++n) {
            const int node = min(first + n * WARPS, own - 1), low = row_start[node] - base, high = row_start[node + 1] - base;
            sum[n] = 0;
#pragma unroll
            for (int e = 0; e < 16; e += 8) {
                const int k = low + e + entry, there = min(k, high - 1);
                const real *a = blocks + 9 * there + 3 * r, *v = values + 3 * columns[there];
                const real product = a[0] * v[0] + a[1] * v[1] + a[2] * v[2];
                sum[n] += lane < 24 && k < high ? product : 0;
            }
            for (int k = low + 16 + entry; k < high && lane < 24; k += 8) {
                const real *a = blocks + 9 * k + 3 * r, *v = values + 3 * columns[k];
                sum[n] += a[0] * v[0] + a[1] * v[1] + a[2] * v[2];
            }
        }
        for (int k = 12; k >= 3; k >>= 1)
#pragma unroll
            for (int n = 0; n < N; ++n) sum[n] += __shfl_down_sync(ALL, sum[n], k);
    }

    // Three at a time: lane 9 e + 3 r + c has entry (r, c) of block e, so that A is read in order.
    template <int N>
    __device__ __forceinline__ void of_far(int first, real sum[N]) const {
        const int lane = threadIdx.x % 32, entry = lane / 9, c = lane % 3;
#pragma unroll
        for (int n = 0; n < N; ++n) {
            const int node = min(first + n * WARPS, own - 1), low = row_start[node] - base, high = row_start[node + 1] - base;
            sum[n] = 0;
#pragma unroll
            for (int e = 0; e < 15; e += 3) {
                const int k = low + e + entry, there = min(k, high - 1);
                const real product = blocks[9ll * there + lane % 9] * values[3 * __ldg(columns + there) + c];
                sum[n] += lane < 27 && k < high ? product : 0;
            }
            for (int k = low + 15 + entry; k < high && lane < 27; k += 3)
                sum[n] += blocks[9ll * k + lane % 9] * values[3 * __ldg(columns + k) + c];
        }
#pragma unroll
        for (int n = 0; n < N; ++n) {
            sum[n] += __shfl_down_sync(ALL, sum[n], 9) + __shfl_down_sync(ALL, sum[n], 18);  // lanes 0 to 8: entry (r, c)
            sum[n] += __shfl_down_sync(ALL, sum[n], 1) + __shfl_down_sync(ALL, sum[n], 2);   // lanes 0, 3, 6: row r
            sum[n] = __shfl_sync(ALL, sum[n], lane < 3 ? 3 * lane : 0);
        }
    }

    // The values that A multiplies: those of exchange `number` + beta what they are.
    template <class T>
    __device__ __forceinline__ void form(const Word<T>* from, unsigned number, real beta) const {
        for (int first = threadIdx.x; first < 3 * halo; first += 3 * THREADS) {
            Word<T> seen[3];
            T got[3];
            int at[3];
            bool all;
#pragma unroll
            for (int n = 0; n < 3; ++n) {
                const int k = min(first + n * THREADS, 3 * halo - 1);
                at[n] = place[k / 3] + k % 3;
            }
            unsigned spins = 0;
            do {  // no branch between the loads: they travel together
#pragma unroll
                for (int n = 0; n < 3; ++n) seen[n] = from[at[n]].seen();
                all = true;
#pragma unroll
                for (int n = 0; n < 3; ++n) all &= seen[n].is(got[n], number);
            } while (again(!all, spins));
#pragma unroll
            for (int n = 0; n < 3; ++n) {
                const int k = first + n * THREADS;
                if (k < 3 * halo) values[k] = beta != 0 ? got[n] + beta * values[k] : got[n];
            }
        }
        __syncthreads();
    }
};
