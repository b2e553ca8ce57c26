// SPDX-License-Identifier: MIT
// Elastic energy of the bodies, on demand after a step: an effect's energies of elements, summed in a fixed order. A launch for each
// effect, a thread block for each body.
#ifndef local
#define local real
#endif
#include "energy_record.cuh"

struct Elastic {
    const local* energy;    // (elements,) [J]
    const int* parts;       // (bodies + 1,) elements of each body
    double* sum;            // (bodies,) over the effects so far [J]
    const long long* step;  // (1,) completed
    Balance* balance;       // (bodies,)
    Energy* told;           // (capacity, bodies) on the host
    int capacity, begins;   // 1: the first effect
};

#ifdef ELASTIC_BYTES  // as energies.py has it
static_assert(sizeof(Elastic) == ELASTIC_BYTES, "layouts of Elastic differ");
#endif

constexpr int THREADS = 128;

extern "C" __global__ void __launch_bounds__(THREADS) elastic(const Elastic p) {
    __shared__ double warps[THREADS / 32];
    const int body = blockIdx.x;
    double sum = 0;
    for (int k = p.parts[body] + threadIdx.x; k < p.parts[body + 1]; k += THREADS) sum += (double)p.energy[k];
    for (int by = 16; by; by /= 2) sum += __shfl_xor_sync(EVERYBODY, sum, by);
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = sum;
    __syncthreads();
    if (threadIdx.x) return;
    sum = p.begins ? 0 : p.sum[body];
    for (int k = 0; k < THREADS / 32; ++k) sum += warps[k];
    p.sum[body] = sum;
    const long long done = p.step[0];
    if (done > 0 && !p.balance[body].found) p.told[(done - 1) % p.capacity * gridDim.x + body].elastic = sum;
}
