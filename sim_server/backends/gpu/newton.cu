// SPDX-License-Identifier: MIT
// Newton-Raphson iteration within a step on a GPU, independent for each body (decisions: kernels/newton_line_search.cuh). The graph of a step is
//     assemble, begin_newton, trial, while a body is not done (blocks of A, trial), end_newton, integrate
//     trial: pcg, update_state, forces, accept_trial
// with all trials that a scene allows in place of the loop where the driver has none: linearizations (1 + trials). The device decides:
// the phase of a body tells each launch whether it applies to the body; once all bodies are done, launches return at once. The kernels that
// decide tell the loop, too, and the end is part of the kernel that integrates (newton_end.cuh), since each launch takes its time.
//
// With a bound of the error of positions (ERRORS), a trial that was taken is judged by the next solve, whose first P^-1 b tells the
// displacement that is left: where that is within the bound, or no more linearizations are allowed, it ends the search (bounded_search.cuh).
#include "newton_begin.cuh"
#include "newton_end.cuh"
#include "bounded_search.cuh"
#ifdef BUDGETS
#include "clock.cuh"
#include "step_budget.cuh"
#endif

// Of update_state, whose thread blocks have parts of ranges, so that small bodies, too, use many multiprocessors.
constexpr int LANES = 8;                                        // threads of a node
constexpr int PART_NODES = BLOCK_NODES / PARTS, ALL_LANES = PART_NODES * LANES;

// Sums over a body by thread blocks of update_state; true in the one thread that has the result, in the one that finishes last.
__device__ __forceinline__ bool sum_lanes(const NewtonArguments& p, const NodeRange& here, double (&sum)[2]) {
    constexpr int ALL_WARPS = ALL_LANES / 32;
    __shared__ double warps[ALL_WARPS][2];
    add_over_warp(sum);
    if (threadIdx.x % 32 == 0)
        for (int n = 0; n < 2; ++n) warps[threadIdx.x / 32][n] = sum[n];
    __syncthreads();  // all writes of this thread block are done
    if (threadIdx.x >= 32) return false;
    const int lane = threadIdx.x;
    for (int n = 0; n < 2; ++n) sum[n] = lane < ALL_WARPS ? warps[lane][n] : 0;
    return sum_body(p, here, blockIdx.x, sum, PARTS);
}

#ifdef LOOPS
extern "C" __device__ void cudaGraphSetConditional(unsigned long long handle, unsigned value);  // of the driver, which links it
#endif

// Tells the loop of the step's graph, 0: there is none, whether it goes on. It does not unless it is told.
__device__ __forceinline__ void tell_loop([[maybe_unused]] unsigned long long loop, [[maybe_unused]] bool goes_on) {
#ifdef LOOPS
    if (loop) cudaGraphSetConditional(loop, goes_on);
#endif
}

// Publishes the phase of a body after a decision. The last body to be done ends the loop, in which no other says anything else then.
__device__ __forceinline__ void decided(const NewtonArguments& p, int body, unsigned long long loop) {
    const int phase = p.search[body].phase;
#ifdef ERRORS
    p.phase[body] = is_awaited(phase) ? SOLVE : phase;
#else
    p.phase[body] = phase;
#endif
    if (phase != DONE) tell_loop(loop, true);
    else if (atomicSub(p.active, 1) == 1) tell_loop(loop, false);
}

// Search direction of node i after the solve: R y; at the first linearization plus the predictor, from which it starts.
__device__ __forceinline__ void direction_of(const NewtonArguments& p, int i, bool first, double (&direction)[3]) {
    const double y[3] = {(double)p.y[3 * i], (double)p.y[3 * i + 1], (double)p.y[3 * i + 2]};
    rotate_node(p.rotation + 9ll * i, false, y, direction);
    if (!first) return;
    const real* predictor = p.initial_state + 6ll * p.nodes + 3 * i;
    for (int k = 0; k < 3; ++k) direction[k] += predictor[k];
}

// Sets the state of node i to that after increment + scale direction.
__device__ __forceinline__ void set_state(const NewtonArguments& p, int i, const SearchedNode& node, double scale) {
    const StartOfStep& start = node.start;
    for (int c = 0; c < 3; ++c) {
        const int k = 3 * i + c;
        const double increment = node.increment[c] + scale * node.direction[c];
        const NodeState s = state_after(start.x[c], start.v[c], start.predictor[c], start.inertial_increment[c], increment, p.dx_dv, node.beta);
        p.x[k] = (real)s.x;
        p.v[k] = (real)s.v;
        p.predictor[k] = 0;
        p.inertial_increment[k] = (real)s.inertial_increment;
        p.damping_velocity[k] = (real)s.damping_velocity;
    }
}

// Begins the iteration where that is not done beside another kernel.
extern "C" __global__ void __launch_bounds__(BLOCK_NODES) begin_newton(const NewtonArguments p) { begin_range(p, blockIdx.x); }

#ifdef ERRORS
// Ends a search whose state a solve has judged: adds z to the increment, which is zero where it is not to be.
__device__ __forceinline__ void end_search(const NewtonArguments& p, const NodeRange& here, int i, bool mine, unsigned long long loop) {
    const int body = here.body;
    Search& search = p.search[body];
    if (mine) {
        double z[3];
        direction_of(p, i, false, z);
        for (int c = 0; c < 3; ++c) {
            const int k = 3 * i + c;
            p.increment[k] = increment_after(search, p.increment[k], p.direction[k]) + z[c];
        }
    }
    double none[2] = {0, 0};
    if (!sum_lanes(p, here, none)) return;
    search.seconds += result_of(p, body).seconds;
    search.verdict = NONE_YET;
    search.phase = DONE;
    decided(p, body, loop);
}
#endif

// q += A_ik s_k of block k, with s the search direction.
__device__ __forceinline__ void add_block(const NewtonArguments& p, int k, int column, bool first, double (&q)[3]) {
    double direction[3], material[3];
    const real* a = p.values + 9ll * k;
    direction_of(p, column, first, direction);
    rotate_node(p.rotation + 9ll * column, true, direction, material);
    for (int c = 0; c < 3; ++c) q[c] += a[3 * c] * material[0] + a[3 * c + 1] * material[1] + a[3 * c + 2] * material[2];
}

// A s at node i, the part of a lane. The columns of two blocks are read at once, since each read is a trip.
__device__ __forceinline__ void multiply_row(const NewtonArguments& p, int begin, int end, int lane, bool first, double (&q)[3]) {
    for (int k = begin + lane; k < end; k += 2 * LANES) {
        const int other = k + LANES, column = p.columns[k], next = p.columns[other < end ? other : k];
        add_block(p, k, column, first, q);
        if (other < end) add_block(p, other, next, first, q);
    }
}

// Sets the state of the next trial: along a new direction after a solve, else with a shorter step along the present one.
// Reads that do not depend on each other stand together, since their latencies are most of its time.
extern "C" __global__ void __launch_bounds__(ALL_LANES) update_state(const NewtonArguments p, unsigned long long loop) {
    const NodeRange here = p.ranges[blockIdx.x / PARTS];
    const PcgResult& r = result_of(p, here.body);
    Search& search = p.search[here.body];
    const int i = here.first + blockIdx.x % PARTS * PART_NODES + threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const bool inside = i < here.last, mine = inside && lane == 0;
    const int begin = inside ? p.row_start[i] : 0, end = inside ? p.row_start[i + 1] : 0;
    const int phase = search.phase, linearizations = search.linearizations, status = r.status;
    if (blockIdx.x == 0 && threadIdx.x == 0) *p.pool_counter = 0;
    if (*p.active == 0) return;
#ifdef ERRORS
    if (p.phase[here.body] == DONE) return;  // that of the search may be what the solve has decided
#else
    if (phase == DONE) return;
#endif
    if (phase == TRY) {
        if (mine) set_state(p, i, searched_node(p, i), search.scale);
        return;
    }
#ifdef ERRORS
    if (is_over(search, r, p.bodies[here.body].position > 0)) return end_search(p, here, i, mine, loop);
#endif
    const bool lost = status == NOT_FINITE, first = linearizations == 0;
    double sum[2] = {0, 0};
    if (!lost) {
        double direction[3] = {0, 0, 0}, material[3] = {0, 0, 0}, q[3] = {0, 0, 0};
        SearchedNode node;
        if (mine) {
            node = searched_node(p, i);
            direction_of(p, i, first, direction);
            rotate_node(p.rotation + 9ll * i, true, direction, material);
        }
        multiply_row(p, begin, end, lane, first, q);
        for (int k = LANES / 2; k; k >>= 1)
            for (int c = 0; c < 3; ++c) q[c] += __shfl_xor_sync(WHOLE_WARP, q[c], k);
        if (mine) {
            for (int c = 0; c < 3; ++c) {
                sum[0] += material[c] * q[c];
                sum[1] += q[c] * q[c];
                node.increment[c] = increment_after(search, node.increment[c], node.direction[c]);
                node.direction[c] = direction[c];
            }
            for (int c = 0; c < 3; ++c) {
                p.increment[3 * i + c] = node.increment[c];
                p.direction[3 * i + c] = direction[c];
            }
            set_state(p, i, node, 1);
        }
    } else if (mine) {
        for (int k = 3 * i; k < 3 * i + 3; ++k) p.increment[k] = increment_after(search, p.increment[k], p.direction[k]);
    }
    if (!sum_lanes(p, here, sum)) return;
    record_solve(search, r.residual, r.seconds, r.iterations, r.fallbacks, r.kind, r.status);
#ifdef ERRORS
    search.solve_error = as_known(r.solve_error);
#endif
    if (!lost) begin_line_search(search, sum[0], sqrt(sum[1]));
    decided(p, here.body, loop);
}

// Decides on an assembled trial: accept, shorten, or end the iteration.
extern "C" __global__ void __launch_bounds__(BLOCK_NODES) accept_trial(const NewtonArguments p, unsigned long long loop) {
    const NodeRange here = p.ranges[blockIdx.x];
    Search& search = p.search[here.body];
    const int i = here.first + threadIdx.x, phase = search.phase;
    double sum[2] = {0, 0};
    if (i < here.last) {
        double material[3];
        rotate_node(p.rotation + 9ll * i, true, p.direction + 3 * i, material);
        for (int c = 0; c < 3; ++c) {
            const double b = p.b[3 * i + c];
            sum[0] += b * b;
            sum[1] += material[c] * b;
        }
    }
    if (*p.active == 0 || phase != TRY) return;
    if (i < here.last)
        for (int c = 0; c < 3; ++c) p.y[3 * i + c] = 0;  // the last solution is no initial guess for a correction
    if (!sum_body(p, here, blockIdx.x, sum)) return;
    Limits most = {p.linearizations, p.trials, p.tolerance};
#ifdef BUDGETS
    const PcgBody& settings = p.bodies[here.body];
    if (settings.most_linearizations > 0) most.linearizations = settings.most_linearizations;
    if (search.status == BUDGET) most.linearizations = search.linearizations;
#endif
    evaluate_trial(search, most, sqrt(sum[0]), sum[1]);
#ifdef ERRORS
    const bool bounded = p.bodies[here.body].position > 0;
    if (search.verdict == TAKEN && bounded) search.step_error = search.solve_error;
    if (search.verdict == TAKEN && search.phase == DONE && (bounded || search.status == BUDGET)) search.phase = LAST;
#endif
#ifdef BUDGETS
    TrialClock& clock = p.clocks[here.body];
    clock.decided = nanoseconds();
    clock.forces = 1e-9 * (clock.decided - clock.solved);
    end_by_budget(search, settings, clock, *p.begun, clock.decided);
#endif
    decided(p, here.body, loop);
}

// Ends the iteration where that is not done within another kernel.
extern "C" __global__ void __launch_bounds__(BLOCK_NODES) end_newton(const NewtonArguments p) {
    const NodeRange here = p.ranges[blockIdx.x];
    const int i = here.first + threadIdx.x;
    if (i < here.last) end_node(p, i, here.body);
    end_step_of_newton(p, blockIdx.x, gridDim.x);
}
