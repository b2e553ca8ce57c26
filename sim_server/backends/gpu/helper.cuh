// SPDX-License-Identifier: MIT
// A second device that applies a part of the partitioned inverses of large bodies (helper.cu). -DHELPED
//
// A body's plan has tasks for twice its thread blocks; the second half of them is done by as many thread blocks of the helper, in whose
// memory their matrices are. Vectors have a copy on each device, at a constant distance. A word that the other device may read is
// written twice, so that everybody reads words in memory of its own. The solver tells each application by a command; that a block of the
// helper has finished with it, its share of z . r tells.
#pragma once
#include "block_group.cuh"

constexpr int COMMAND_WORDS = 8;
// Flags of a plan's lists (inverse/halves.py): who reads what this device writes. DevicePlan.target, WarpSegment.kind, DevicePlan.place.
constexpr int NEAR_READS = 16777216, FAR_READS = 33554432;
constexpr int FORMED_FAR = 4;
constexpr int RESIDUAL_FAR = 1073741824;
constexpr unsigned SEQUENCE = 0x9e3779b9u;     // commands of launch k have the numbers SEQUENCE k + 1, + 2, ...
constexpr unsigned MOST_COMMANDS = 0x1000000u;  // of a launch, so that none of the launch before is taken for one of this

struct Help {  // of all bodies, argument of pcg.cu
    const long long* far;              // (rows,) by PcgBody.helper: bytes from a word of the body's vectors to the helper's copy
    FlagWord<float>* commands;         // (bodies, COMMAND_WORDS) in the helper's memory
    const FlagWord<double>* sums;      // (2, ranges) its shares of z . r, by thread block
    unsigned* sent;                    // (bodies,) commands in this step
    const unsigned* launches;          // (1,) of the helper before this one
    long long ranges;                  // thread blocks of all bodies
};

// A word as each of the first threads of a warp has one.
struct Command {
    int row;                           // of HelperArguments.bodies; 0: the step has no more
    unsigned number, r_number, q_number;  // of exchanges; number 0: nothing is to be applied yet
    int first, later;                  // halves of the residual's words, in the first phase and in the others
    float alpha, unit;
};

__device__ __forceinline__ void put_far(FlagWord<float>& word, long long far, float v, unsigned number) {
    if (far) ((FlagWord<float>*)((char*)&word + far))->put(v, number);
}

__device__ __forceinline__ void put_command(FlagWord<float>* to, const Command& c, unsigned sequence) {
    const unsigned words[COMMAND_WORDS] = {(unsigned)c.row, c.number, c.r_number, c.q_number, (unsigned)c.first, (unsigned)c.later,
                                           __float_as_uint(c.alpha), __float_as_uint(c.unit)};
    unsigned mine = 0;
#pragma unroll
    for (int k = 0; k < COMMAND_WORDS; ++k) mine = threadIdx.x == k ? words[k] : mine;
    if (threadIdx.x < COMMAND_WORDS) to[threadIdx.x].put(__uint_as_float(mine), sequence);
}

#ifndef HELPER
struct BodyHelp {  // in shared memory
    long long far;                     // 0: none
    FlagWord<float>* commands;
    const FlagWord<double>* sums;      // of the first thread block of the body
    long long ranges;
    unsigned* sent;
    unsigned sequence;                 // of the last command
    unsigned base;
    double total;

    // By one thread.
    __device__ __forceinline__ void begin(const Help& help, int k, const PcgBody& body) {
        far = body.plan && body.helper ? help.far[body.helper] : 0;
        commands = help.commands + COMMAND_WORDS * k;
        sums = help.sums + body.first_range;
        ranges = help.ranges;
        sent = help.sent + k;
        base = SEQUENCE * *help.launches;
        sequence = base + *sent;
    }

    // Has the helper bring what it needs of an inverse. By the first thread block, as `apply` and `end`.
    __device__ __forceinline__ void prepare(int row) { send({row, 0, 0, 0, 0, 0, 0, 0}); }

    __device__ __forceinline__ void apply(int row, int first, unsigned r_number, unsigned q_number, float alpha, int later, unsigned number,
                                          float unit) {
        send({row, number, r_number, q_number, first, later, alpha, unit});
    }

    __device__ __forceinline__ void send(const Command& c) {
        put_command(commands, c, sequence + 1);
        __syncthreads();
        if (threadIdx.x == 0) ++sequence;
    }

    __device__ __forceinline__ void end() const {
        if (threadIdx.x == 0) *sent = sequence - base;
    }

    // The helper's share of a sum that the group has just added up; the helper has then read what it needs of this application.
    __device__ __forceinline__ double sum(const BlockGroup& group) {
        if (group.warp == 0) {
            const double found = group.read(sums + (group.number & 1) * ranges);
            if (group.lane == 0) total = found;
        }
        __syncthreads();
        return total;
    }
};
#endif
