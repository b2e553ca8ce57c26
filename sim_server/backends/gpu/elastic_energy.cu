// SPDX-License-Identifier: MIT
// Elastic energy of the bodies, on demand after a step: sums of the element energies of an effect in a fixed order. One launch per
// effect, one thread block per body. Also what a change of parameters between two steps adds to it.
#ifndef local
#define local real
#endif
#include "energy_record.cuh"

struct ElasticEnergy {
    const local* energy;         // (elements,) [J]
    const int* first_element;    // (bodies + 1,) elements of each body
    double* sum;                 // (bodies,) over the effects so far [J]
    const long long* step;       // (1,) completed
    Balance* balance;            // (bodies,)
    EnergyRecord* records;       // (capacity, bodies)
    int capacity, first_effect;  // 1: the first effect
};

struct ElasticWork {             // of a change of parameters
    const double* sum;           // (bodies,) elastic energy [J]
    double* before;              // (bodies,) before the change [J]
    Balance* balance;            // (bodies,)
    int bodies, after;           // after: 1 once it is made
};

constexpr int THREADS = 128;

extern "C" __global__ void __launch_bounds__(THREADS) elastic_energy(const ElasticEnergy p) {
    __shared__ double warps[THREADS / 32];
    const int body = blockIdx.x;
    double sum = 0;
    for (int k = p.first_element[body] + threadIdx.x; k < p.first_element[body + 1]; k += THREADS) sum += (double)p.energy[k];
    for (int by = 16; by; by /= 2) sum += __shfl_xor_sync(FULL_WARP, sum, by);
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = sum;
    __syncthreads();
    if (threadIdx.x) return;
    sum = p.first_effect ? 0 : p.sum[body];
    for (int k = 0; k < THREADS / 32; ++k) sum += warps[k];
    p.sum[body] = sum;
    const long long done = p.step[0];
    if (done > 0 && !p.balance[body].found) p.records[(done - 1) % p.capacity * gridDim.x + body].elastic = sum;
}

// Launched twice, each time after the elastic energy: what a change of parameters adds to it is work.
extern "C" __global__ void __launch_bounds__(THREADS) elastic_work(const ElasticWork p) {
    const int body = blockIdx.x * blockDim.x + threadIdx.x;
    if (body >= p.bodies) return;
    if (p.after) add_work(p.balance[body], p.sum[body] - p.before[body], p.before[body]);
    else p.before[body] = p.sum[body];
}
