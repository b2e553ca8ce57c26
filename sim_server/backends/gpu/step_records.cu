// SPDX-License-Identifier: MIT
// Writes the records of a batch of steps into the ring of the host, which its loop then completes by what only it knows (loop.cpp).
// They lie one behind the other there, so that the writes of a warp, 256 bytes from a multiple of that on, travel together.
#include "energy_record.cuh"
#include "step_record.cuh"
#include "step_results.cuh"

struct StepRecords {
    const RecordTarget* target;    // on the host
    const PcgResult* results;      // (capacity, bodies)
    const EnergyRecord* energies;  // (capacity, bodies)
    Record* records;               // (room,) on the host
    long long room;
    int capacity, bodies;
};

constexpr int TOGETHER = 64;  // records of a thread block at a time
constexpr int THREADS = 128, WORDS = sizeof(Record) / 8;

__device__ __forceinline__ Record record_of(const PcgResult& solve, const EnergyRecord& energy) {
    Record record;
    note_solve(record, solve);
    record.factor_step = solve.factor_step;
    record.asked = solve.asked;
    record.bad_node = solve.bad_node;
    record.probe = solve.probe;
    if (solve.solve_error > 0) record.solve_error = solve.solve_error;
    note_energy(record, energy);
    return record;
}

extern "C" __global__ void __launch_bounds__(THREADS) write_records(const StepRecords a) {
    __shared__ long long words[TOGETHER * WORDS];
    __shared__ RecordTarget target;
    if (threadIdx.x < 3) ((long long*)&target)[threadIdx.x] = ((const volatile long long*)a.target)[threadIdx.x];
    __syncthreads();
    const int count = (int)target.steps * a.bodies;
    const long long first_slot = target.first % a.capacity, place = target.place % a.room;
    for (int from = blockIdx.x * TOGETHER; from < count; from += gridDim.x * TOGETHER) {
        const int here = count - from < TOGETHER ? count - from : TOGETHER;
        for (int k = threadIdx.x; k < here; k += THREADS) {
            const int step = (from + k) / a.bodies, body = from + k - step * a.bodies;
            const long long slot = (first_slot + step) % a.capacity * a.bodies + body;
            const Record record = record_of(a.results[slot], a.energies[slot]);
            memcpy(words + k * WORDS, &record, sizeof record);
        }
        __syncthreads();
        const int before = (place + from) * WORDS % 32;  // words of the ring since the last multiple of 256 bytes
        for (int k = (int)threadIdx.x - before; k < here * WORDS; k += THREADS) {
            if (k < 0) continue;
            long long at = place + from + k / WORDS;
            if (at >= a.room) at -= a.room;
            ((long long*)(a.records + at))[k % WORDS] = words[k];
        }
        __syncthreads();
    }
}
