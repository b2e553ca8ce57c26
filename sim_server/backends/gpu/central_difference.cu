// SPDX-License-Identifier: MIT
// Explicit substeps on a GPU (central_difference.py): sums over the nodes of a body, one thread block of each, and what is decided
// between the kernels of the substeps (kernels/stable_step.cuh). A step is a loop of rounds, each of state.round substeps.
#include "energy_balance.cu"
#include "kinds.h"
#include "stable_step.cuh"
#include "step_results.cuh"

constexpr int THREADS = 32 * WARPS;

struct Substeps {
    EnergyBalance energy;        // arrays of the balance, which tells whether a body runs away
    SubstepState* state;         // (1,)
    StableStep* stable;          // (bodies,)
    real* force;                 // (n, 3) of the last evaluation [N]
    real* mode;                  // (n, 3) u [m]
    const real* kept_x;          // (n, 3) [m]
    const real* kept_force;      // (n, 3) [N]
    real* substep;               // (1,) [s]
    real* shift_time;            // (1,) [s]
    int* failed;                 // (bodies,) 1: the step gave no state
    int* away;                   // (bodies,) 1: the body runs away in the step
    int *due, *runs, *opens;     // (1,) of the round to come: with an estimate; there is one; it begins the step
    unsigned* finished;          // (1,) thread blocks that are done; zero between launches
    PcgResult* results;          // (capacity, bodies)
    SubstepResult* told;         // (capacity, bodies) on the host
    double dt;                   // of a step [s]
};

__device__ ModeSums sums_of_modes(ModeSums s) {
    __shared__ ModeSums warps[WARPS];
    for (int by = 16; by; by /= 2) {
        ModeSums o;
        o.mode = __shfl_xor_sync(FULL_WARP, s.mode, by);
        o.next = __shfl_xor_sync(FULL_WARP, s.next, by);
        o.largest = __shfl_xor_sync(FULL_WARP, s.largest, by);
        o.quotient = __shfl_xor_sync(FULL_WARP, s.quotient, by);
        join(s, o);
    }
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = s;
    __syncthreads();
    s = warps[0];
    for (int k = 1; k < (int)blockDim.x / 32; ++k) join(s, warps[k]);
    return s;
}

// Takes the frequency of each body from the forces at x + u, makes the next u, and sets x and the forces back. k: number of the
// iteration.
extern "C" __global__ void __launch_bounds__(THREADS) measure_frequency(const Substeps p, int k) {
    const EnergyBalance& e = p.energy;
    const int body = blockIdx.x, first = e.first_node[body], last = e.first_node[body + 1];
    ModeSums s = no_mode();
    for (int i = first + threadIdx.x; i < last; i += blockDim.x)
        if (e.free[i] != 0) add_mode(s, e.mass[i], p.mode + 3ll * i, p.kept_force + 3ll * i, p.force + 3ll * i);
    s = sums_of_modes(s);
    const StableStep stable = p.stable[body];
    for (int i = first + threadIdx.x; i < last; i += blockDim.x) {
        real* u = p.mode + 3ll * i;
        if (e.free[i] == 0) u[0] = u[1] = u[2] = 0;
        else next_mode(stable, s, k, i, e.mass[i], p.kept_force + 3ll * i, p.force + 3ll * i, u);
        for (long long c = 3ll * i; c < 3ll * i + 3; ++c) {
            e.x[c] = p.kept_x[c];
            p.force[c] = p.kept_force[c];
        }
    }
    __syncthreads();  // all have read `stable`
    if (threadIdx.x == 0) {
        StableStep next = stable;
        note_frequency(next, s, k);
        p.stable[body] = next;
    }
}

// Least stable step of all bodies, in all threads of a thread block.
__device__ double least_stable_step(const Substeps& p) {
    __shared__ double least[THREADS];
    double found = 1e300;
    for (int k = threadIdx.x; k < p.energy.bodies; k += blockDim.x) {
        const double stable = stable_step_of(p.stable[k]);
        found = stable < found ? stable : found;
    }
    least[threadIdx.x] = found;
    __syncthreads();
    for (int k = 0; k < (int)blockDim.x; ++k) found = least[k] < found ? least[k] : found;
    return found;
}

// Begins the rounds of a step, or begins them again.
__device__ void begin_rounds(const Substeps& p, SubstepState& s) {
    s.left = s.substeps;
    p.substep[0] = (real)(p.dt / s.substeps);
    *p.due = p.energy.force || s.since >= ESTIMATE_EVERY;  // there may be new grabs
    *p.runs = *p.opens = 1;
}

extern "C" __global__ void __launch_bounds__(THREADS) begin_substeps(const Substeps p) {
    const double stable = least_stable_step(p);
    if (threadIdx.x) return;
    SubstepState s = *p.state;
    begin_step(s, p.dt, stable);
    begin_rounds(p, s);
    *p.state = s;
}

// After an estimate within a step.
extern "C" __global__ void __launch_bounds__(THREADS) shorten_substeps(const Substeps p) {
    const double stable = least_stable_step(p);
    if (threadIdx.x) return;
    SubstepState s = *p.state;
    double substep = p.substep[0], shift = 0;
    shorten(s, stable, &substep, &shift);
    s.since = 0;
    *p.state = s;
    p.substep[0] = (real)substep;
    p.shift_time[0] = (real)shift;
}

__device__ void write_results(const Substeps& p, const SubstepState& s) {
    const EnergyBalance& e = p.energy;
    const long long slot = e.step[0] % e.capacity * e.bodies;
    for (int k = threadIdx.x; k < e.bodies; k += blockDim.x) {
        p.results[slot + k] = {0, 0, -1, 0, p.failed[k] ? NOT_FINITE : CONVERGED, NONE, NONE, 0, -1, 0};
        p.told[slot + k] = {stable_step_of(p.stable[k]), s.substeps};
    }
}

// Ends a round, and with the last one the step, unless a body runs away.
extern "C" __global__ void __launch_bounds__(THREADS) end_round(const Substeps p) {
    __shared__ int last, left;
    const EnergyBalance& e = p.energy;
    const int body = blockIdx.x;
    SubstepState s = *p.state;
    if (s.left <= s.round) {
        Sums sums = sums_over(e, e.first_node[body], e.first_node[body + 1]);
        for (int i = e.first_node[body] + threadIdx.x; e.force && i < e.first_node[body + 1]; i += blockDim.x) {
            const real *x = e.x + 3ll * i, *from = e.before + 3ll * i;
            const double step[3] = {(double)x[0] - from[0], (double)x[1] - from[1], (double)x[2] - from[2]};
            sums.work += work_on(e.force + 3ll * i, e.spring[i], e.anchor + 3ll * i, from, step);
        }
        sums.work += load_work_over(e, e.first_node[body], e.first_node[body + 1]);
        sums = sums_of_block(sums);
        if (threadIdx.x == 0) {
            Balance balance = e.balance[body];
            update_balance(balance, sums, GO_ON, true);
            p.away[body] = balance.found;
            p.failed[body] = !is_finite(sums.kinetic) || !is_finite(sums.gravity);
        }
    }
    __syncthreads();
    if (threadIdx.x == 0) {
        __threadfence();
        last = atomicAdd(p.finished, 1u) == gridDim.x - 1u;
        left = 0;
    }
    __syncthreads();
    if (!last) return;
    __threadfence();
    s.left -= s.round;
    s.since += s.round;
    if (s.left <= 0) {
        for (int k = threadIdx.x; k < e.bodies; k += blockDim.x)
            if (__ldcg(p.away + k)) atomicAdd(&left, 1);
        __syncthreads();
        write_results(p, s);  // of another try again
    }
    if (threadIdx.x) return;
    *p.opens = 0;
    *p.due = s.since >= ESTIMATE_EVERY;
    *p.runs = s.left > 0;
    if (s.left <= 0 && left && try_again(s)) begin_rounds(p, s);
    *p.state = s;
    p.finished[0] = 0;
}
