// SPDX-License-Identifier: MIT
// What a second device does in a solve: its thread blocks' part of each application of a partitioned inverse (helper.cuh).
#define HELPED
#define HELPER
#include "partitioned_inverse.cuh"

struct HelperArguments {
    const PcgBody* bodies;             // by PcgBody.helper, with addresses in this device's memory, but for their inverse's
    const long long* far;              // likewise: bytes from a word to the solver's copy
    const FlagWord<float>* commands;   // (bodies, COMMAND_WORDS)
    FlagWord<double>* sums;            // (2, ranges) in the solver's memory
    const unsigned* launches;          // (1,) before this one
    const RowRange* row_ranges;        // of all thread blocks of all bodies
    const int* initial_range;          // (grid,) of each thread block, -1: none
    int ranges, shared;                // bytes of dynamic shared memory
};

struct HelperMemory {
    PcgBody body;
    DevicePlan plan;
    PartitionedInverse inverse;
    unsigned command[COMMAND_WORDS], sequence;
    double scratch[WARPS];
};
__shared__ HelperMemory memory;

// Waits for a command of this launch after `last`, and sets `last` to its number. The solver waits for the answers to an application before
// it goes on, so that only commands without one are passed over: they have nothing that later ones do not tell.
__device__ __forceinline__ Command next_command(const FlagWord<float>* words, unsigned base, unsigned& last) {
    __syncthreads();  // the last one has been read
    if (threadIdx.x < 32) {
        const int k = threadIdx.x % COMMAND_WORDS;
        FlagWord<float> word;
        unsigned sequence;
        bool whole;
        unsigned spins = 0;
        do {
            word = words[k].load();
            sequence = (unsigned)(word.bits >> 32);
            whole = sequence == __shfl_sync(ALL, sequence, 0) && sequence != last && sequence - base - 1 < MOST_COMMANDS;
        } while (keep_polling(!__all_sync(ALL, whole), spins));
        if (threadIdx.x < COMMAND_WORDS) memory.command[k] = (unsigned)word.bits;
        if (threadIdx.x == 0) memory.sequence = sequence;
    }
    __syncthreads();
    last = memory.sequence;
    const unsigned* w = memory.command;
    return {(int)w[0], w[1], w[2], w[3], (int)w[4], (int)w[5], __uint_as_float(w[6]), __uint_as_float(w[7])};
}

// Brings what belongs to an inverse.
template <class T>
__device__ __forceinline__ void bring(T& to, const T* from) {
    for (int i = threadIdx.x; i < (int)(sizeof(T) / 4); i += THREADS) ((int*)&to)[i] = __ldcg((const int*)from + i);
}

__device__ __forceinline__ void set_up(const HelperArguments& h, int row, int block) {
    copies_end<0>();
    __syncthreads();
    bring(memory.body, h.bodies + row);
    __syncthreads();
    bring(memory.plan, memory.body.plan);
    __syncthreads();
    Arena arena = {shared_memory, shared_memory + h.shared};
    PartitionedInverse inverse;
    inverse.far = h.far[row];
    const int index = memory.body.blocks + block;  // behind the thread blocks of the solver
    inverse.reserve(&memory.plan, index, arena);
    inverse.set_up(memory.body, index, arena);
    if (threadIdx.x == 0) memory.inverse = inverse;
    copies_end<0>();
    __syncthreads();
    inverse.fetch();
}

// This thread block's share of z . r, to the solver, once it has read all that it needs.
__device__ __forceinline__ void put_sum(FlagWord<double>* to, double mine, unsigned number) {
    for (int k = 16; k; k >>= 1) mine += __shfl_xor_sync(ALL, mine, k);
    if (threadIdx.x % 32 == 0) memory.scratch[threadIdx.x / 32] = mine;
    __syncthreads();
    if (threadIdx.x > 0) return;
    double sum = 0;
    for (int k = 0; k < WARPS; ++k) sum += memory.scratch[k];
    to->put(sum, number);
}

__device__ __forceinline__ double apply(const Command& c) {
    const PartitionedInverse inverse = memory.inverse;
    const long long half = inverse.size + 32;
    ResidualSource from = {inverse.residual + c.first * half, c.r_number, c.q_number, c.alpha};
    double mine = 0;
    copies_end<0>();
    for (int phase = 0; phase < inverse.phases; ++phase) {
        inverse.gather(phase, from, c.number, c.unit);
        __syncthreads();
        mine += inverse.multiply(phase, from, c.number, c.unit);
        from = {inverse.residual + c.later * half, c.number, 0, 0};
    }
    return mine;
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) help(const HelperArguments h) {
    const int range = h.initial_range[blockIdx.x];
    if (range < 0) return;
    const RowRange own = h.row_ranges[range];
    const FlagWord<float>* commands = h.commands + COMMAND_WORDS * own.body;
    const unsigned base = SEQUENCE * *h.launches;
    unsigned last = base;
    for (int row = 0;;) {
        const Command c = next_command(commands, base, last);
        if (c.row == 0) break;
        if (c.row != row) {
            row = c.row;
            set_up(h, row, own.index);
        }
        if (c.number == 0) continue;
        const double mine = apply(c);
        put_sum(h.sums + (long long)((c.number + 1) & 1) * h.ranges + range, mine, c.number + 1);
    }
    copies_end<0>();
}

// One thread: counts a launch of `help`, which has ended.
extern "C" __global__ void count_launch(unsigned* launches) { ++*launches; }

// On the solver's device, one thread block: tells the helper that the step has no more applications.
extern "C" __global__ void dismiss(FlagWord<float>* commands, unsigned* sent, unsigned* launches, int bodies) {
    for (int k = 0; k < bodies; ++k) {
        put_command(commands + COMMAND_WORDS * k, {0, 0, 0, 0, 0, 0, 0, 0}, SEQUENCE * *launches + sent[k] + 1);
        __syncthreads();
        if (threadIdx.x == 0) sent[k] = 0;
    }
    if (threadIdx.x == 0) ++*launches;
}
