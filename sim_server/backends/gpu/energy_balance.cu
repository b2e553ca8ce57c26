// SPDX-License-Identifier: MIT
// Energy balance of each body after a step, and detection of runaways (kernels/energy_balance.cuh). A thread block sums over a chunk of a
// body's nodes; the last one of a body to finish adds the chunks in a fixed order, decides, and freezes a runaway. It runs as the
// prologue of the kernel over elements that begins the next step (kernel_fusion.py), or by itself after the last step of a batch. A
// step is settled once: later launches for it do nothing.
#include "energy_record.cuh"
#include "node_chunk.cuh"

constexpr int STILL = 5, WARPS = 4;  // most arrays that are 0 at rest; most warps of a thread block

struct EnergyBalance {
    const int* first_node;      // (bodies + 1,) node of each body
    const NodeChunk* chunks;    // (chunks,)
    Sums* sums;                 // (chunks,)
    unsigned* finished_chunks;  // (bodies,) chunks that are summed up; zero between launches
    const real* mass;           // (n,) [kg]
    const real* before;         // (n, 3) x when the step began [m]
    real* x;                    // (n, 3) [m]
    const real* v;              // (n, 3) [m/s]
    real* still[STILL];         // (n, 3) each, or null: v and what else is 0 in a body at rest
    real* force;                // (n, 3) of touches (effects/touch.cu); null: nothing can be touched
    real* spring;               // (n,)
    real* anchor;               // (n, 3)
    const real* load;           // (n, 3) of the effects with loads (effects/_loads.py), or null
    real* free;                 // (n,) set to 0 where a body is frozen
    const real* gravity;        // (3,) [m/s2]
    Balance* balance;           // (bodies,)
    EnergyRecord* records;      // (capacity, bodies)
    const long long* step;      // (1,) completed
    long long* settled_step;    // (bodies,) step that was settled last
    int bodies, capacity, on_runaway, inertia;
};

__device__ __forceinline__ void add_sums(Sums& a, const Sums& b) {
    a.kinetic += b.kinetic;
    a.gravity += b.gravity;
    a.fallen += b.fallen;
    a.work += b.work;
    for (int c = 0; c < 3; ++c) {
        a.low[c] = b.low[c] < a.low[c] ? b.low[c] : a.low[c];
        a.high[c] = b.high[c] > a.high[c] ? b.high[c] : a.high[c];
    }
}

// Sums over this thread's nodes of [begin, end).
__device__ __forceinline__ Sums sums_over(const EnergyBalance& a, int begin, int end) {
    Sums s = no_sums();
#pragma unroll 4
    for (int i = begin + threadIdx.x; i < end; i += blockDim.x) {
        const real *x = a.x + 3ll * i, *from = a.before + 3ll * i;
        const double step[3] = {(double)x[0] - from[0], (double)x[1] - from[1], (double)x[2] - from[2]};
        add_node(s, a.mass[i], x, a.v + 3ll * i, step, a.gravity);
    }
    return s;
}

// Work of loads.
__device__ __forceinline__ double load_work_over(const EnergyBalance& a, int begin, int end) {
    double work = 0;
    for (long long i = begin + threadIdx.x; a.load && i < end; i += blockDim.x)
        for (long long k = 3 * i; k < 3 * i + 3; ++k) work += (double)a.load[k] * ((double)a.x[k] - a.before[k]);
    return work;
}

// Work of touch forces on the same nodes; sets the forces to 0 until the next touch.
__device__ __forceinline__ double work_over(const EnergyBalance& a, int begin, int end) {
    double work = 0;
    for (int i = begin + threadIdx.x; i < end; i += blockDim.x) {
        real *force = a.force + 3ll * i, &spring = a.spring[i];
        if (spring == 0 && force[0] == 0 && force[1] == 0 && force[2] == 0) continue;
        const real *x = a.x + 3ll * i, *from = a.before + 3ll * i;
        const double step[3] = {(double)x[0] - from[0], (double)x[1] - from[1], (double)x[2] - from[2]};
        work += work_on(force, spring, a.anchor + 3ll * i, from, step);
        force[0] = force[1] = force[2] = spring = 0;
    }
    return work;
}

// Sums of the lane whose number differs in the bits `by`.
__device__ __forceinline__ Sums sums_across(const Sums& s, int by) {
    Sums o;
    o.kinetic = __shfl_xor_sync(FULL_WARP, s.kinetic, by);
    o.gravity = __shfl_xor_sync(FULL_WARP, s.gravity, by);
    o.fallen = __shfl_xor_sync(FULL_WARP, s.fallen, by);
    o.work = __shfl_xor_sync(FULL_WARP, s.work, by);
    for (int c = 0; c < 3; ++c) {
        o.low[c] = __shfl_xor_sync(FULL_WARP, s.low[c], by);
        o.high[c] = __shfl_xor_sync(FULL_WARP, s.high[c], by);
    }
    return o;
}

__device__ void write_record(const EnergyBalance& a, const Balance& b, int body, long long done) {
    EnergyRecord& e = a.records[done % a.capacity * a.bodies + body];
    e.kinetic = b.kinetic;
    e.elastic = __longlong_as_double(0x7ff8000000000000ll);  // not evaluated
    e.gravity = b.gravity;
    e.work = b.work;
    e.budget = b.budget;
    e.stride = b.stride;
    e.phase = b.phase;
    e.found = b.found;
}

// Puts a body back to the state before the step, at rest, with all nodes fixed from now on.
__device__ void freeze(const EnergyBalance& a, int body) {
    for (int i = a.first_node[body] + threadIdx.x; i < a.first_node[body + 1]; i += blockDim.x) {
        a.free[i] = 0;
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) {
            a.x[k] = a.before[k];
            for (real* array : a.still)
                if (array) array[k] = 0;
        }
    }
}

// Returns the sums over the thread block, in its first thread. Their order depends on the number of threads alone.
__device__ Sums sums_of_block(Sums s) {
    __shared__ Sums warps[WARPS];
    for (int by = 16; by; by /= 2) add_sums(s, sums_across(s, by));
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = s;
    __syncthreads();
    if (threadIdx.x == 0)
        for (int k = 1; k < (int)blockDim.x / 32; ++k) add_sums(s, warps[k]);
    return s;
}

// True if this thread block is the last one of its body to finish; s then holds the sums over all chunks in the first thread.
__device__ bool gather(const EnergyBalance& a, const NodeChunk& chunk, int number, Sums& s) {
    if (chunk.chunks == 1) return true;
    __shared__ bool last;
    if (threadIdx.x == 0) {
        a.sums[number] = s;
        __threadfence();
        last = atomicAdd(a.finished_chunks + chunk.body, 1u) == chunk.chunks - 1u;
    }
    __syncthreads();
    if (!last) return false;
    __threadfence();
    s = no_sums();
    for (int k = threadIdx.x; k < chunk.chunks; k += blockDim.x) add_sums(s, a.sums[chunk.first + k]);
    s = sums_of_block(s);
    if (threadIdx.x == 0) a.finished_chunks[chunk.body] = 0;
    return true;
}

// Done by thread block `number`. All loads depend on the chunk alone, so that their latencies overlap.
__device__ void balance_energy(const EnergyBalance& a, int number) {
    __shared__ int away;
    const NodeChunk chunk = a.chunks[number];
    const long long step = a.step[0], settled = a.settled_step[chunk.body];
    Balance b = a.balance[chunk.body];
    Sums s = sums_over(a, chunk.begin, chunk.end);
    if (settled == step) return;
    if (a.force) s.work = work_over(a, chunk.begin, chunk.end);
    if (a.load) s.work += load_work_over(a, chunk.begin, chunk.end);
    s = sums_of_block(s);
    if (!gather(a, chunk, number, s)) return;
    if (threadIdx.x == 0) {
        away = update_balance(b, s, a.on_runaway, a.inertia);
        a.balance[chunk.body] = b;
        write_record(a, b, chunk.body, step - 1);
        a.settled_step[chunk.body] = step;
    }
    __syncthreads();
    if (away) freeze(a, chunk.body);
}

extern "C" __global__ void __launch_bounds__(32 * WARPS) energy_balance(const EnergyBalance a) { balance_energy(a, blockIdx.x); }
