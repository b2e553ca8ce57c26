// SPDX-License-Identifier: MIT
// y = P^-1 b of all bodies whose factor stands in for A (method: mechanics/rosenbrock.py), in one launch: thread blocks, exchanges and
// the inverse are those of pcg.cu, without a matrix and without iterations.
//
// The first application of a step chooses the form of each body's attempt (stages.cuh).
#include "partitioned_inverse.cuh"
#include "clock.cuh"
#include "stages.cuh"

struct ApplicationMemory {  // static shared memory of a thread block
    double scratch[3 * WARPS][4], totals[4];
    PcgBody body;
    DevicePlan plan;
    StageState state;
    int next, moving, bad;
};
__shared__ ApplicationMemory memory;

struct OwnPlaces {  // of the own degrees of freedom: positions in the packed vectors and scales; in shared memory, if they fit
    int* position;
    float* scale;

    __device__ __forceinline__ void set_up(const RowRange& range, const float* scales, Arena& arena) {
        position = arena.take<int>(3 * range.own);
        scale = arena.take<float>(3 * range.own);
        if (!scale) return;
        for (int k = threadIdx.x; k < 3 * range.own; k += THREADS) {  // read by the same threads
            position[k] = memory.plan.place[range.begin + k / 3] + k % 3;
            scale[k] = scales[position[k]];
        }
    }
};

struct FactorApplication {
    const PcgArguments& s;
    const RowRange& range;
    const PartitionedInverse& inverse;
    const OwnPlaces& own;
    BlockGroup group;

    // Copies the rows of the body into shared memory.
    template <class T>
    static __device__ __forceinline__ void bring(T& to, const T* from) {
        for (int i = threadIdx.x; i < (int)(sizeof(T) / 4); i += THREADS) ((int*)&to)[i] = ((const int*)from)[i];
    }

    __device__ __forceinline__ void fill(real value) const {
        const long long begin = 3 * (memory.body.first + (long long)range.begin);
        for (int k = threadIdx.x; k < 3 * range.own; k += THREADS) s.y[begin + k] = value;
    }

    // True if a grab pulls at an own node by a spring, or it loses elements in this step.
    static __device__ __forceinline__ bool pulled(const StageSolve& t, const PcgBody& body, const RowRange& range) {
        bool found = false;
        if (t.spring)
            for (int k = threadIdx.x; k < range.own; k += THREADS) found |= t.spring[body.first + range.begin + k] != 0;
        if (t.changed_at)
            for (int k = threadIdx.x; k < range.own; k += THREADS) found |= t.changed_at[body.first + range.begin + k] == *t.clock;
        return found;
    }

    // Keeps what the second application needs of the first.
    __device__ __forceinline__ void keep(const StageSolve& t, int number, long long k, real value) const {
        t.first_stage[3ll * s.nodes * number + k] = value;
    }

    // y_1 . (b_1 - A y_1) and y_1 . b_1 of an own degree of freedom; b: of the second stage (stages.cuh).
    __device__ __forceinline__ void compare(const StageSolve& t, long long k, double b, double sums[2]) const {
        const long long n = 3ll * s.nodes;
        const double first_b = t.first_stage[n + k], y = t.first_stage[2 * n + k];
        const double theta = t.share[k / 3], w = t.weight[k / 3], mass = t.mass[k / 3];
        sums[0] += y * first_residual(t.first_stage[k], first_b, b, y, theta, w, mass, mass * w / theta);  // without springs
        sums[1] += y * first_b;
    }

    // Applies the factor; false if a grab pulls at the body, whose y then keeps its values. Only the first application looks.
    __device__ __forceinline__ bool apply(const StageSolve& t, bool mine_pulled, PcgResult& out, double& inconsistency) {
        const long long begin = 3 * (memory.body.first + (long long)range.begin);
        const unsigned r_number = group.number;
        double mine[4] = {0, mine_pulled ? 1.0 : 0.0, 0, 0}, sums[4];
        for (int k = threadIdx.x; k < 3 * range.own; k += THREADS) {
            const int at = place(k);
            const real b = s.b[begin + k];
            inverse.residual[at].put((float)((own.scale ? own.scale[k] : inverse.scale[at]) * b), r_number);
            mine[0] += (double)b * (double)b;
            if (t.first_of_step) {
                keep(t, 0, begin + k, s.y[begin + k]);
                keep(t, 1, begin + k, b);
            } else {
                compare(t, begin + k, b, mine + 2);
            }
        }
        for (int k = 16; k; k >>= 1)
            for (int n = 0; n < 4; ++n) mine[n] += __shfl_xor_sync(ALL, mine[n], k);
        group.sums<4, 1>(mine, sums);
        inconsistency = sums[3] != 0 ? fabs(sums[2] / sums[3]) : 0;
        copies_end<0>();
        __syncthreads();
        if (sums[1] > 0) return false;
        if (!isfinite(sums[0])) {
            out.status = NOT_FINITE;
            out.residual = sums[0];
            out.bad_node = first_bad_node(memory.body, s.b, memory.bad);
            fill((real)(0 * sums[0]));
            return true;
        }
        if (sums[0] == 0) {
            fill(0);
            if (t.first_of_step)
                for (int k = threadIdx.x; k < 3 * range.own; k += THREADS) keep(t, 2, begin + k, 0);
            return true;
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
            const FlagWord<float>* z = inverse.z + place(k);
            float value;
            for (unsigned spins = 0; keep_polling(!z->get(value, group.number), spins);) {}
            s.y[begin + k] = value;
            if (t.first_of_step) keep(t, 2, begin + k, value);
        }
        return true;
    }

    __device__ __forceinline__ int place(int k) const {
        return own.scale ? own.position[k] : memory.plan.place[range.begin + k / 3] + k % 3;
    }
};

__device__ __forceinline__ void apply_to_body(const PcgArguments& s, const StageSolve& t, const RowRange& range) {
    const int k = range.body;
    FactorApplication::bring(memory.body, s.bodies + k);
    FactorApplication::bring(memory.state, t.state + k);
    if (threadIdx.x == THREADS - 1) memory.moving = s.moving[k];
    __syncthreads();
    const PcgBody& body = memory.body;
    const bool decides = range.index == 0 && threadIdx.x == 0;
    bool alone = t.first_of_step ? may_use_factor(memory.state, body) : memory.state.form == FACTOR;
    const bool pulled = t.first_of_step && FactorApplication::pulled(t, body, range);
    if (pulled) t.state[k].springs = 1;  // all of them write the same
    PcgResult& sum = s.results[(s.step[0] % s.capacity) * s.count + k];
    if (decides && t.first_of_step) sum = no_solve(body);
    if (alone && memory.moving) {
        FactorApplication::bring(memory.plan, body.plan);
        __syncthreads();
        const long long begin = nanoseconds();
        Arena arena = {shared_memory, shared_memory + s.shared};
        PartitionedInverse inverse;
        OwnPlaces own;
        inverse.reserve(&memory.plan, range.index, arena);
        own.set_up(range, body.scale, arena);
        inverse.set_up(body, range.index, arena);
        inverse.fetch();  // beside the exchange
        FactorApplication solver = {s, range, inverse, own,
                                    {range.index, body.blocks, s.exchange_number[k], s.block_sums + 8ll * s.grid * k, s.grid, memory.scratch,
                                     memory.totals, (int)threadIdx.x % 32, (int)threadIdx.x / 32}};
        PcgResult out = no_solve(body);
        out.at_rest = 0;
        double inconsistency;
        alone = solver.apply(t, pulled, out, inconsistency);
        if (decides) {
            if (!t.first_of_step) t.state[k].inconsistency = inconsistency;
            out.seconds = 1e-9 * (nanoseconds() - begin);
            add_solve(sum, out);
            s.exchange_number[k] = solver.group.number + 1;  // no word has it; read by all blocks before the exchange
        }
    }
    if (decides && t.first_of_step) t.state[k].form = alone ? FACTOR : ITERATE;
    copies_end<0>();  // the next body uses the same memory
    __syncthreads();
}

extern "C" __global__ void __launch_bounds__(THREADS, PER_PROCESSOR) apply_factor(const PcgArguments s, const StageSolve t) {
    for (int next = s.initial_range[blockIdx.x];; next = -1) {
        if (next < 0) {  // take the next body of the pool
            if (threadIdx.x == 0) memory.next = s.pooled > 0 ? atomicAdd(s.pool_counter, 1) : s.pooled;
            __syncthreads();
            if (memory.next >= s.pooled) return;
            next = s.bodies[s.order[s.count - s.pooled + memory.next]].first_range;
        }
        apply_to_body(s, t, s.row_ranges[next]);
    }
}
