// SPDX-License-Identifier: MIT
// z = P^-1 r by the factors of the bodies of islands that iterate (island_state.cuh), in one launch: thread blocks, exchanges and the
// inverse are those of pcg.cu, as in apply_factor.cu.
#include "island_state.cuh"
#include "partitioned_inverse.cuh"

struct ApplicationMemory {  // static shared memory of a thread block
    double scratch[3 * WARPS][4], totals[4];
    PcgBody body;
    DevicePlan plan;
    int next, iterates;
};
__shared__ ApplicationMemory memory;

// Copies a struct into shared memory.
template <class T> __device__ __forceinline__ void bring(T& to, const T* from) {
    for (int i = threadIdx.x; i < (int)(sizeof(T) / 4); i += THREADS) ((int*)&to)[i] = ((const int*)from)[i];
}

__device__ __forceinline__ void apply(const IslandArguments& a, const PartitionedInverse& inverse, BlockGroup& group, const RowRange& range) {
    const long long begin = 3 * (memory.body.first + (long long)range.begin);
    const unsigned r_number = group.number;
    double mine[1] = {0}, sums[1];
    for (int k = threadIdx.x; k < 3 * range.own; k += THREADS) {
        const int at = memory.plan.place[range.begin + k / 3] + k % 3;
        const double r = a.r[begin + k];
        inverse.residual[at].put((float)(inverse.scale[at] * r), r_number);
        mine[0] += r * r;
    }
    for (int k = 16; k; k >>= 1) mine[0] += __shfl_xor_sync(ALL, mine[0], k);
    group.sums<1, 1>(mine, sums);
    copies_end<0>();
    __syncthreads();
    if (!(sums[0] > 0) || !isfinite(sums[0])) {
        for (int k = threadIdx.x; k < 3 * range.own; k += THREADS) a.z[begin + k] = sums[0];  // 0, or what ends the solve
        return;
    }
    const double peak = inverse.scale[inverse.size];
    const float unit = unit_for(sums[0] * peak * peak);
    ResidualSource from = {inverse.residual, r_number, 0, 0};
    for (int phase = 0; phase < inverse.phases; ++phase) {
        inverse.gather(phase, from, group.number, unit);
        __syncthreads();
        inverse.multiply(phase, from, group.number, unit);
    }
    for (int k = threadIdx.x; k < 3 * range.own; k += THREADS) {
        const FlagWord<float>* z = inverse.z + memory.plan.place[range.begin + k / 3] + k % 3;
        float value;
        for (unsigned spins = 0; keep_polling(!z->get(value, group.number), spins);) {}
        a.z[begin + k] = value;
    }
}

__device__ __forceinline__ void apply_to_body(const PcgArguments& s, const IslandArguments& a, const RowRange& range) {
    const int k = range.body;
    bring(memory.body, s.bodies + k);
    if (threadIdx.x == THREADS - 1) {
        const int island = a.island_of[k];
        memory.iterates = island >= 0 && a.state[island].stage == ITERATES && a.state[island].factors;
    }
    __syncthreads();
    const PcgBody& body = memory.body;
    if (memory.iterates && body.kind == CHOLESKY && body.plan) {
        bring(memory.plan, body.plan);
        __syncthreads();
        Arena arena = {shared_memory, shared_memory + s.shared};
        PartitionedInverse inverse;
        inverse.reserve(&memory.plan, range.index, arena);
        inverse.set_up(body, range.index, arena);
        inverse.fetch();  // beside the exchange
        BlockGroup group = {range.index, body.blocks, s.exchange_number[k], s.block_sums + 8ll * s.grid * k, s.grid, memory.scratch,
                            memory.totals, (int)threadIdx.x % 32, (int)threadIdx.x / 32};
        apply(a, inverse, group, range);
        if (range.index == 0 && threadIdx.x == 0) s.exchange_number[k] = group.number + 1;  // read by all blocks before the exchange
    }
    copies_end<0>();  // the next body uses the same memory
    __syncthreads();
}

extern "C" __global__ void __launch_bounds__(THREADS, PER_PROCESSOR) island_factor(const PcgArguments s, const IslandArguments a) {
    for (int next = s.initial_range[blockIdx.x];; next = -1) {
        if (next < 0) {  // take the next body of the pool
            if (threadIdx.x == 0) memory.next = s.pooled > 0 ? atomicAdd(s.pool_counter, 1) : s.pooled;
            __syncthreads();
            if (memory.next >= s.pooled) return;
            next = s.bodies[s.order[s.count - s.pooled + memory.next]].first_range;
        }
        apply_to_body(s, a, s.row_ranges[next]);
    }
}
