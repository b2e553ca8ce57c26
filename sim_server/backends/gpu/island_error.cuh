// SPDX-License-Identifier: MIT
// Estimated errors of the solves of bodies that touch each other on a GPU (-DERRORS; method: kernels/error_estimate.cuh; rules of the CPU:
// backends/cpu/native/island.h). Kernels over nodes leave largest values of their thread blocks, and the thread that decides for an island
// reads them. Only z of the present iterate ends a solve, so that it makes an iteration more than on a CPU where that of the one before would.
#pragma once
#include "island_state.cuh"
#include "iterate_error.cuh"

struct IslandError {
    IterateError of;
    double told;          // of the last solve [m], 0: not known
};
static_assert(sizeof(IslandError) <= ERROR_BYTES, "see island_memory.py");

__device__ __forceinline__ IslandError& error_of(const IslandArguments& a, int island) { return *(IslandError*)(a.errors + (long long)ERROR_BYTES * island); }

// Before a solve of an island whose right-hand side has the square b2. last: it may end by its estimate.
__device__ void begin_error(const IslandArguments& a, int island, const IslandState& s, double b2, bool last) {
    IslandError& error = error_of(a, island);
    double position = a.bodies[a.island[a.island_start[island]]].position, trust = OTHER_TRUST;
#pragma unroll 4
    for (int k = 0; k < s.bodies; ++k) {
        const PcgBody& body = a.bodies[a.island[a.island_start[island] + k]];
        position = fmin(position, body.position);
        trust = fmax(trust, body.trust);
    }
    error.of.begin(last ? position : 0, trust, a.c.dx_dv);
    error.of.b2 = b2;
    error.of.limit2 = WITHIN * WITHIN * a.c.tolerance * a.c.tolerance * s.given2;
    error.told = 0;
}

// The square of the residual to which a solve is expected to go.
__device__ double expected_end2(const IslandArguments& a, int island, double goal2) {
    const IterateError& error = error_of(a, island).of;
    return error.position > 0 ? fmax(goal2, error.limit2) : goal2;
}

// Largest values over the thread block, in all of its threads.
template <int THREADS_OF_BLOCK> __device__ void most_of_block(double (&most)[2]) {
    __shared__ double warps[THREADS_OF_BLOCK / 32][2];
    for (int k = 16; k; k >>= 1)
        for (int n = 0; n < 2; ++n) most[n] = fmax(most[n], __shfl_xor_sync(WARP, most[n], k));
    __syncthreads();  // earlier contents have been read
    if (threadIdx.x % 32 == 0)
        for (int n = 0; n < 2; ++n) warps[threadIdx.x / 32][n] = most[n];
    __syncthreads();
    for (int n = 0; n < 2; ++n)
        for (int k = 0; k < THREADS_OF_BLOCK / 32; ++k) most[n] = fmax(most[n], warps[k][n]);
}

// Largest squares over the nodes of a thread block, left for peaks_of. Done by all of it.
__device__ void leave_peaks(const IslandArguments& a, double z2, double change2) {
    double most[2] = {z2, change2};
    most_of_block<CONTACT_THREADS>(most);
    if (threadIdx.x < 2) __stcg(a.peaks + 2ll * blockIdx.x + threadIdx.x, pick(most, threadIdx.x));
}

struct Peaks { double size, change; };  // |z|, and the change of x since it was last looked at

// Of an island, in all threads of the thread block.
template <int THREADS_OF_BLOCK = CONTACT_THREADS> __device__ Peaks peaks_of(const IslandArguments& a, int island) {
    const int first = a.island_start[island], bodies = a.island_start[island + 1] - first;
    double most[2] = {0, 0};
    for (int k = threadIdx.x; k < bodies * a.most_chunks; k += THREADS_OF_BLOCK) {
        const int body = a.island[first + k / a.most_chunks], chunk = a.chunk_first[body] + k % a.most_chunks;
        if (chunk >= a.chunk_first[body + 1]) continue;
        for (int n = 0; n < 2; ++n) most[n] = fmax(most[n], __ldcg(a.peaks + 2ll * chunk + n));
    }
    most_of_block<THREADS_OF_BLOCK>(most);
    return {sqrt(most[0]), sqrt(most[1])};
}

// Square of the change of x at a node.
__device__ __forceinline__ double change2_at(const IslandArguments& a, int i) {
    double sum = 0;
    for (long long k = 3ll * i; k < 3ll * i + 3; ++k) sum += (a.x[k] - a.before[k]) * (a.x[k] - a.before[k]);
    return sum;
}

// z is P^-1 of the residual whose square is r2, rz = z . r. Returns whether the solve ends here; x is looked at where that is due. By one
// thread.
__device__ bool ends_by_estimate(const IslandArguments& a, int island, const IslandState& s, double rz, double r2, const Peaks& peaks) {
    IterateError& error = error_of(a, island).of;
    error.apply(s.factors ? CHOLESKY : BLOCK_JACOBI, rz, r2, peaks.size, peaks.change);
    return error.enough;
}
