// SPDX-License-Identifier: MIT
// Newton-Raphson iteration within a step on a GPU, independent for each body (decisions: kernels/newton_line_search.cuh). The graph of a step is
//     assemble, begin_newton, trial, while a body is not done (blocks of A, trial), end_newton, integrate
//     trial: pcg, update_state, forces, accept_trial
// with all trials that a scene allows in place of the loop where the driver has none: linearizations (1 + trials). The device decides:
// the phase of a body tells each launch whether it applies to the body; once all bodies are done, launches return at once.
//
// With a bound of the error of positions (ERRORS), a trial that was taken is judged by the next solve, whose first P^-1 b tells the
// displacement that is left: where that is within the bound, or no more linearizations are allowed, it ends the search (bounded_search.cuh).
//
// A thread block has a range of a body's nodes; the last one of a body to finish adds the partial sums in a fixed order and makes
// the body's decision. Sums and the increment are double for every `real`.
#include "pcg_structs.cuh"
#include "bounded_search.cuh"

#ifndef local
#define local real
#endif

constexpr int BLOCK_NODES = 32, LANES = 8, ALL_LANES = BLOCK_NODES * LANES;  // nodes of a thread block; threads of a node in update_state
constexpr int NO_NODE = 0x7fffffff;
#define WARP 0xffffffffu

struct NodeRange { int body, first, last, unused; };  // nodes [first, last) of the scene

struct NewtonArguments {
    const NodeRange* ranges;       // (grid,) by body
    const int* first_range;        // (bodies + 1,) of each body
    double* partial_sums;          // (grid, 2) sums of the ranges
    unsigned* finished_blocks;     // (bodies,) zero between launches
    Search* search;                // (bodies,)
    int* phase;                    // (bodies,) of each body's search, read by the other launches
    int* active;                   // (1,) bodies whose iteration is not over
    int* bad_node;                 // (bodies,) first node whose b is not finite
    const PcgBody* bodies;
    PcgResult* results;            // (capacity, bodies) of the last solve; at the end of the step
    NewtonResult* newton_results;  // (capacity, bodies) on the host
    const long long* step;         // (1,) completed
    unsigned* pool_counter;        // (1,) of the solver; set to zero before each of its launches
    const int* row_start;
    const int* columns;
    const real* values;            // (blocks, 3, 3)
    const real* b;                 // (nodes, 3) material frame
    real* y;                       // (nodes, 3) material frame: the solution; zero before the solves of corrections; for `advance`
    const local* rotation;         // (nodes, 3, 3)
    const real* mass;              // (nodes,) in A [kg]
    const real* beta;              // (nodes,) [s]
    real* x;                       // (nodes, 3) [m]
    real* v;                       // (nodes, 3) [m/s]
    real* predictor;               // likewise
    real* damping_velocity;
    real* inertial_increment;
    real* initial_state;           // (4, nodes, 3) x, v, predictor, inertial_increment before the step
    double* increment;             // (nodes, 3) [m/s]
    double* direction;             // (nodes, 3) [m/s]
    double dx_dv;                  // [s]
    double tolerance;
    int linearizations, trials, nodes, count, capacity;
};

__device__ __forceinline__ void add_up(double (&sum)[2]) {
    for (int k = 16; k; k >>= 1)
        for (int n = 0; n < 2; ++n) sum[n] += __shfl_xor_sync(WARP, sum[n], k);
}

// Sums over a thread block, in thread 0.
template <int THREADS>
__device__ __forceinline__ void sum_block(double (&sum)[2]) {
    add_up(sum);
    if constexpr (THREADS > 32) {
        __shared__ double warps[THREADS / 32][2];
        __syncthreads();  // earlier contents have been read
        if (threadIdx.x % 32 == 0)
            for (int n = 0; n < 2; ++n) warps[threadIdx.x / 32][n] = sum[n];
        __syncthreads();
        for (int n = 0; n < 2; ++n) {
            sum[n] = 0;
            for (int k = 0; k < THREADS / 32; ++k) sum[n] += warps[k][n];
        }
    }
}

// Sums over a body; true in the one thread that has the result, in the thread block that finishes last.
template <int THREADS>
__device__ __forceinline__ bool sum_body(const NewtonArguments& p, int body, double (&sum)[2]) {
    __shared__ bool last;
    const int first = p.first_range[body], end = p.first_range[body + 1];
    sum_block<THREADS>(sum);
    __syncthreads();  // all writes of this thread block are done
    if (threadIdx.x == 0) {
        for (int n = 0; n < 2; ++n) __stcg(p.partial_sums + 2 * blockIdx.x + n, sum[n]);
        __threadfence();
        last = atomicAdd(p.finished_blocks + body, 1u) == (unsigned)(end - first) - 1;
    }
    __syncthreads();
    if (!last) return false;
    __threadfence();
    sum[0] = sum[1] = 0;
    for (int k = first + threadIdx.x; k < end; k += THREADS)
        for (int n = 0; n < 2; ++n) sum[n] += __ldcg(p.partial_sums + 2 * k + n);
    sum_block<THREADS>(sum);
    if (threadIdx.x == 0) p.finished_blocks[body] = 0;
    return threadIdx.x == 0;
}

__device__ __forceinline__ PcgResult& result_of(const NewtonArguments& p, int body) {
    return p.results[(p.step[0] % p.capacity) * p.count + body];
}

// Publishes the phase of a body after a decision.
__device__ __forceinline__ void decided(const NewtonArguments& p, int body) {
    const int phase = p.search[body].phase;
#ifdef ERRORS
    p.phase[body] = phase == LAST ? SOLVE : phase;
#else
    p.phase[body] = phase;
#endif
    if (phase == DONE) atomicSub(p.active, 1);
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
__device__ __forceinline__ void set_state(const NewtonArguments& p, int i, double scale) {
    const long long n = 3ll * p.nodes;
    for (int k = 3 * i; k < 3 * i + 3; ++k) {
        const double increment = p.increment[k] + scale * p.direction[k];
        const NodeState s = state_after(p.initial_state[k], p.initial_state[n + k], p.initial_state[2 * n + k],
                                        p.initial_state[3 * n + k], increment, p.dx_dv, p.beta[i]);
        p.x[k] = (real)s.x;
        p.v[k] = (real)s.v;
        p.predictor[k] = 0;
        p.inertial_increment[k] = (real)s.inertial_increment;
        p.damping_velocity[k] = (real)s.damping_velocity;
    }
}

// Begins the iteration after the first assembly of a step: keeps the state, and sets increment = -predictor.
extern "C" __global__ void __launch_bounds__(BLOCK_NODES) begin_newton(const NewtonArguments p) {
    const NodeRange here = p.ranges[blockIdx.x];
    const int i = here.first + threadIdx.x;
    double sum[2] = {0, 0};
    if (i < here.last) {
        const long long n = 3ll * p.nodes;
        for (int k = 3 * i; k < 3 * i + 3; ++k) {
            p.initial_state[k] = p.x[k];
            p.initial_state[n + k] = p.v[k];
            p.initial_state[2 * n + k] = p.predictor[k];
            p.initial_state[3 * n + k] = p.inertial_increment[k];
            p.increment[k] = -(double)p.predictor[k];
            sum[0] += (double)p.b[k] * (double)p.b[k];
        }
        int k = p.row_start[i];
        if (p.row_start[i + 1] - k > 1) {  // else fixed
            while (p.columns[k] != i) ++k;
            sum[1] = elastic_impulse_square(p.values + 9ll * k, p.x + 3 * i, (double)p.mass[i], p.dx_dv);
        }
    }
    if (!sum_body<BLOCK_NODES>(p, here.body, sum)) return;
    start_search(p.search[here.body], sqrt(sum[0]), EPSILON<local> * sqrt(sum[1]), p.bodies[here.body].kind);
#ifdef ERRORS
    p.search[here.body].forcing = MOST_FORCING;
#endif
    p.phase[here.body] = SOLVE;
    p.bad_node[here.body] = NO_NODE;
}

#ifdef ERRORS
// Ends a search whose state a solve has judged: adds z to the increment, which is zero where it is not to be.
__device__ __forceinline__ void end_search(const NewtonArguments& p, int body, int i, bool mine) {
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
    if (!sum_body<ALL_LANES>(p, body, none)) return;
    search.seconds += result_of(p, body).seconds;
    search.verdict = NONE_YET;
    search.phase = DONE;
    decided(p, body);
}
#endif

// Sets the state of the next trial: along a new direction after a solve, else with a shorter step along the present one.
extern "C" __global__ void __launch_bounds__(ALL_LANES) update_state(const NewtonArguments p) {
    if (blockIdx.x == 0 && threadIdx.x == 0) *p.pool_counter = 0;
    if (*p.active == 0) return;
    const NodeRange here = p.ranges[blockIdx.x];
    Search& search = p.search[here.body];
#ifdef ERRORS
    if (p.phase[here.body] == DONE) return;  // that of the search may be what the solve has decided
#else
    if (search.phase == DONE) return;
#endif
    const int i = here.first + threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const bool inside = i < here.last, mine = inside && lane == 0;
    if (search.phase == TRY) {
        if (mine) set_state(p, i, search.scale);
        return;
    }
    const PcgResult& r = result_of(p, here.body);
#ifdef ERRORS
    if (is_over(search, r)) return end_search(p, here.body, i, mine);
#endif
    const bool lost = r.status == NOT_FINITE, first = search.linearizations == 0;
    double sum[2] = {0, 0};
    if (!lost) {
        double direction[3] = {0, 0, 0}, material[3], q[3] = {0, 0, 0};
        if (inside)
            for (int k = p.row_start[i] + lane; k < p.row_start[i + 1]; k += LANES) {
                const real* a = p.values + 9ll * k;
                direction_of(p, p.columns[k], first, direction);
                rotate_node(p.rotation + 9ll * p.columns[k], true, direction, material);
                for (int c = 0; c < 3; ++c) q[c] += a[3 * c] * material[0] + a[3 * c + 1] * material[1] + a[3 * c + 2] * material[2];
            }
        for (int k = LANES / 2; k; k >>= 1)
            for (int c = 0; c < 3; ++c) q[c] += __shfl_xor_sync(WARP, q[c], k);
        if (mine) {
            direction_of(p, i, first, direction);
            rotate_node(p.rotation + 9ll * i, true, direction, material);
            for (int c = 0; c < 3; ++c) {
                sum[0] += material[c] * q[c];
                sum[1] += q[c] * q[c];
                p.increment[3 * i + c] = increment_after(search, p.increment[3 * i + c], p.direction[3 * i + c]);
                p.direction[3 * i + c] = direction[c];
            }
            set_state(p, i, 1);
        }
    } else if (mine) {
        for (int k = 3 * i; k < 3 * i + 3; ++k) p.increment[k] = increment_after(search, p.increment[k], p.direction[k]);
    }
    if (!sum_body<ALL_LANES>(p, here.body, sum)) return;
    record_solve(search, r.residual, r.seconds, r.iterations, r.fallbacks, r.kind, r.status);
#ifdef ERRORS
    search.solve_error = as_known(r.solve_error);
#endif
    if (!lost) begin_line_search(search, sum[0], sqrt(sum[1]));
    decided(p, here.body);
}

// Decides on an assembled trial: accept, shorten, or end the iteration.
extern "C" __global__ void __launch_bounds__(BLOCK_NODES) accept_trial(const NewtonArguments p) {
    if (*p.active == 0) return;
    const NodeRange here = p.ranges[blockIdx.x];
    Search& search = p.search[here.body];
    if (search.phase != TRY) return;
    const int i = here.first + threadIdx.x;
    double sum[2] = {0, 0};
    if (i < here.last) {
        double material[3];
        rotate_node(p.rotation + 9ll * i, true, p.direction + 3 * i, material);
        for (int c = 0; c < 3; ++c) {
            const double b = p.b[3 * i + c];
            sum[0] += b * b;
            sum[1] += material[c] * b;
            p.y[3 * i + c] = 0;  // the last solution is no initial guess for a correction
        }
    }
    if (!sum_body<BLOCK_NODES>(p, here.body, sum)) return;
    evaluate_trial(search, {p.linearizations, p.trials, p.tolerance}, sqrt(sum[0]), sum[1]);
#ifdef ERRORS
    if (search.verdict == TAKEN) search.step_error = search.solve_error;
    if (search.verdict == TAKEN && search.phase == DONE) search.phase = LAST;
#endif
    decided(p, here.body);
}

// Restores the state before the step, and sets y so that `advance` arrives at the state found; writes the results of the step.
extern "C" __global__ void __launch_bounds__(BLOCK_NODES) end_newton(const NewtonArguments p) {
    const NodeRange here = p.ranges[blockIdx.x];
    const int body = here.body, i = here.first + threadIdx.x;
    const Search s = p.search[body];
    if (blockIdx.x == 0 && threadIdx.x == 0) *p.active = p.count;  // of the next step
    if (i < here.last) {
        const long long n = 3ll * p.nodes;
        double increment[3], y[3];
        bool finite = true;
        for (int c = 0; c < 3; ++c) {
            const long long k = 3ll * i + c;
            increment[c] = increment_after(s, p.increment[k], p.direction[k]);
            p.x[k] = p.initial_state[k];
            p.v[k] = p.initial_state[n + k];
            p.predictor[k] = p.initial_state[2 * n + k];
            p.inertial_increment[k] = p.initial_state[3 * n + k];
            finite = finite && isfinite(p.b[k]);
        }
        rotate_node(p.rotation + 9ll * i, true, increment, y);
        for (int c = 0; c < 3; ++c) p.y[3 * i + c] = (real)y[c];
        if (s.status == NOT_FINITE && !finite) atomicMin(p.bad_node + body, i - p.ranges[p.first_range[body]].first);
    }
    double none[2] = {0, 0};
    if (!sum_body<BLOCK_NODES>(p, body, none)) return;
    PcgResult& r = result_of(p, body);
    const PcgBody& settings = p.bodies[body];
    const bool used = settings.plan && (r.asked == CHOLESKY || s.kind == CHOLESKY || s.fallbacks);
    r.factor_step = used ? settings.factor_step : -1;
    r.residual = s.residual;
    r.seconds = s.seconds;
    r.iterations = s.iterations;
    r.status = s.status;
    r.kind = s.kind;
    r.fallbacks = s.fallbacks;
    const int bad = __ldcg(p.bad_node + body);
    r.bad_node = s.status == NOT_FINITE && bad != NO_NODE ? bad : -1;
    p.newton_results[(p.step[0] % p.capacity) * p.count + body] = {residual_ratio(s), s.linearizations > 1 ? s.linearizations : 1};
#ifdef ERRORS
    r.solve_error = as_told(s.solve_error);
    p.newton_results[(p.step[0] % p.capacity) * p.count + body].step_error = as_told(s.step_error);
#endif
}
