// SPDX-License-Identifier: MIT
// Solves that were slow with their factor (smoothing_state.cuh) go on here, with conjugate gradients numbered as in pcg.cu. All that travels between thread
// blocks are flag words in the order of the inverse; x, r, p and z are each thread block's own.
#include "partitioned_inverse.cuh"
#include "clock.cuh"
#include "spmv.cuh"
#include "smoothing_state.cuh"

// What an iteration applies. A solve goes on to the next one where one is of no use.
enum Way { SMOOTHED_FACTOR, FACTOR, DIAGONAL, NO_WAY };

struct BlockMemory {  // static shared memory of a thread block
    double scratch[3 * WARPS][4], totals[4];
    PcgBody body;
    DevicePlan plan;
    BlockRows rows;
    PartitionedInverse inverse;
    real* diagonal;   // (own, 9) inverses of the diagonal blocks
    double peak;      // largest scale
};
__shared__ BlockMemory memory;

__device__ __forceinline__ bool usable(double a) { return a > 0 && a < 1e300; }

struct SmoothedSolver {
    BlockGroup group;
    const real* b;        // (own, 3)
    real* y;              // (own, 3) in: start; then p; out: solution
    const real* residual; // (own, 3) of the start, or null
    int sweeps;
    double largest;       // eigenvalue of D^-1 A, 0: not known yet
    SweepWeights weights = {};
    int way = SMOOTHED_FACTOR;

    static __device__ __forceinline__ double warp_sum(double mine) {
        for (int k = 16; k; k >>= 1) mine += __shfl_xor_sync(ALL, mine, k);
        return mine;
    }
    __device__ __forceinline__ double sum(double mine) {
        const double of_warp[1] = {warp_sum(mine)};
        double out[1];
        group.sums<1, 1>(of_warp, out);
        return out[0];
    }

    __device__ __forceinline__ void set_up(const PcgArguments& s, const RowRange& range) const {
        const PcgBody& body = memory.body;
        Arena arena = {shared_memory, shared_memory + s.shared};
        PartitionedInverse inverse;
        inverse.reserve(&memory.plan, group.index, arena);
        BlockRows rows;
        rows.set_up(s, body, range, arena, true, inverse.lent);
        real* diagonal = arena.take<real>(9 * rows.own);
        if (!diagonal) diagonal = s.diagonal + 9ll * (body.first + rows.begin);
        inverse.set_up(body, group.index, arena);
        inverse.fetch();
        copies_end<0>();
        __syncthreads();
        for (int k = threadIdx.x; k < rows.halo; k += THREADS) rows.place[k] = memory.plan.place[rows.nodes[k]];
        for (int node = threadIdx.x; node < rows.own; node += THREADS) {
            int k = rows.row_start[node] - rows.base;
            while (rows.columns[k] != node) ++k;
            invert3(rows.blocks + 9ll * k, true, diagonal + 9 * node);
        }
        __syncthreads();
        for (int k = threadIdx.x; rows.scale && k < 3 * rows.own; k += THREADS) rows.scale[k] = inverse.scale[rows.position(k / 3) + k % 3];
        if (threadIdx.x == 0) {
            memory.rows = rows;
            memory.inverse = inverse;
            memory.diagonal = diagonal;
            memory.peak = inverse.scale[inverse.size];
        }
        __syncthreads();
    }

    static __device__ __forceinline__ int position(int k) { return memory.rows.position(k / 3) + k % 3; }

    // Entry k of D^-1 a. a: (own, 3)
    static __device__ __forceinline__ real by_diagonal(const real* a, int k) {
        const real *of = a + k / 3 * 3, *v = memory.diagonal + 3 * k;
        return v[0] * of[0] + v[1] * of[1] + v[2] * of[2];
    }

    // rows.values = what the thread blocks have put into `words` in this exchange, plus beta times what is there.
    __device__ __forceinline__ void receive(const FlagWord<float>* words, real beta) const {
        memory.rows.form(words, group.number, beta, [](int, float v) { return v; });
    }

    // rows.q = A times rows.values
    __device__ __forceinline__ void multiply() const {
        const BlockRows rows = memory.rows;
        rows.multiply([&](int node, int c, real q) { rows.q[3 * node + c] = q; });
        __syncthreads();
    }

    // rows.x = y, rows.r = b - A y; returns |r|^2.
    __device__ __forceinline__ double start() {
        const BlockRows rows = memory.rows;
        if (!residual) {
            group.barrier();  // y is complete
            const real* all = y - 3 * rows.begin;
            for (int k = threadIdx.x; k < 3 * rows.halo; k += THREADS) rows.values[k] = __ldcg(all + 3 * rows.nodes[k / 3] + k % 3);
            __syncthreads();
            multiply();
        }
        double mine = 0;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            const real r = residual ? residual[k] : b[k] - rows.q[k];
            rows.x[k] = residual ? y[k] : rows.values[k];
            rows.r[k] = r;
            mine += (double)r * (double)r;
        }
        residual = nullptr;
        return sum(mine);
    }

    // Estimates the largest eigenvalue of D^-1 A by the power method from signs of their own for all degrees of freedom, always the same.
    __device__ __forceinline__ double largest_eigenvalue() {
        const BlockRows rows = memory.rows;
        double size2 = 0;
        for (int step = 0; step <= POWER_STEPS; ++step) {
            const real unit = size2 > 0 ? (real)(1 / sqrt(size2)) : 1;
            for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
                const int at = position(k);
                const real v = step > 0 ? unit * by_diagonal(rows.q, k) : ((unsigned)at * 2654435761u >> 16 & 1) ? 1 : -1;
                memory.inverse.product[at].put((float)v, group.number);
            }
            receive(memory.inverse.product, 0);
            multiply();
            double mine = 0;
            for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
                const real w = by_diagonal(rows.q, k);
                mine += (double)w * (double)w;
            }
            size2 = sum(mine);
        }
        return POWER_MARGIN * sqrt(size2);
    }

    // What sweep `n` adds to entry k, q being A times what is there, or nothing being there. before: what the first one has added
    __device__ __forceinline__ real sweep(int n, int k, real before, bool from_zero) const {
        const real *r = memory.rows.r + k / 3 * 3, *q = memory.rows.q + k / 3 * 3, *v = memory.diagonal + 3 * k;
        real update = v[0] * r[0] + v[1] * r[1] + v[2] * r[2];
        if (!from_zero) update -= v[0] * q[0] + v[1] * q[1] + v[2] * q[2];
        return n == 0 ? (real)weights.first * update : (real)weights.second * update + (real)weights.before * before;
    }

    // rows.values = P^-1 r, at the own nodes; returns z . r. r2: |r|^2.
    __device__ __forceinline__ double precondition(double r2) {
        const BlockRows rows = memory.rows;
        const PartitionedInverse& inverse = memory.inverse;
        FlagWord<float>* const other = inverse.residual + inverse.size + PADDING;
        const bool smooth = way == SMOOTHED_FACTOR;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS)
            inverse.product[position(k)].put(smooth ? (float)sweep(0, k, 0, true) : way == FACTOR ? 0 : (float)by_diagonal(rows.r, k), group.number);
        receive(inverse.product, 0);
        if (smooth && sweeps > 1) {
            multiply();
            for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) other[position(k)].put((float)sweep(1, k, rows.values[k], false), group.number);
            receive(other, 1);
        }
        if (way != DIAGONAL) {
            multiply();
            apply_inverse(r2);
            receive(inverse.z, 1);
        }
        if (smooth) {
            multiply();
            if (sweeps > 1) {
                group.number += 2;  // its words are written again; sums go on in turns
                for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) inverse.product[position(k)].put((float)sweep(0, k, 0, false), group.number);
                receive(inverse.product, 1);
                multiply();
            }
        }
        double mine = 0;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            real z = rows.values[k];
            if (smooth) {
                float before = 0;
                if (sweeps > 1) inverse.product[position(k)].get(before, group.number);
                z += sweep(sweeps - 1, k, before, false);
            }
            rows.values[k] = z;
            mine += (double)z * (double)rows.r[k];
        }
        return sum(mine);
    }

    // inverse.z = P^-1 (r - q), in words of this exchange.
    __device__ __forceinline__ void apply_inverse(double r2) const {
        const BlockRows rows = memory.rows;
        const PartitionedInverse inverse = memory.inverse;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            const int at = position(k);
            const real d = rows.scale ? rows.scale[k] : (real)inverse.scale[at];
            inverse.residual[at].put((float)(d * (rows.r[k] - rows.q[k])), group.number);
        }
        const ResidualSource from = {inverse.residual, group.number, 0, 0};
        const float unit = unit_for(16 * r2 * memory.peak * memory.peak);  // A z1 may be larger than r
        for (int phase = 0; phase < inverse.phases; ++phase) {
            inverse.gather(phase, from, group.number, unit);
            __syncthreads();
            inverse.multiply(phase, from, group.number, unit);
        }
    }

    // p = z + beta p, q = A p; sums p.q, r.q, q.q, r.r
    __device__ __forceinline__ void direction(real beta, double out[4]) {
        const BlockRows rows = memory.rows;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            const float p = (float)(rows.values[k] + (beta != 0 ? beta * y[k] : 0));
            y[k] = p;
            memory.inverse.product[position(k)].put(p, group.number);
        }
        __syncthreads();  // z has been read
        receive(memory.inverse.product, 0);
        double mine[4] = {0, 0, 0, 0};
        rows.multiply([&](int node, int c, real q) { rows.keep_product(3 * node + c, q, mine); });
        for (int n = 0; n < 4; ++n) mine[n] = warp_sum(mine[n]);
        group.sums<4, 1>(mine, out);
    }

    // x += alpha p, r -= alpha q; returns |r|^2. sums: of `direction`.
    __device__ __forceinline__ double descend(real alpha, const double sums[4]) const {
        const BlockRows rows = memory.rows;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            rows.x[k] += alpha * rows.values[k];
            rows.r[k] -= alpha * rows.q[k];
        }
        __syncthreads();  // by_diagonal reads what other threads have written
        return fmax(0.0, sums[3] - 2 * alpha * sums[1] + alpha * alpha * sums[2]);
    }

    __device__ __forceinline__ void give() const {
        for (int k = threadIdx.x; k < 3 * memory.rows.own; k += THREADS) __stcg(y + k, memory.rows.x[k]);
    }

    // Completes the result of a solve that pcg.cu has begun.
    __device__ __forceinline__ void solve(PcgResult& out) {
        const int most = memory.body.max_iterations - out.iterations;
        int iterations = 0, status = -1;
        double goal = 0, b2 = 0, last = 1e300, first = 0, r2;
        for (;;) {
            r2 = start();
            if (last == 1e300) {
                b2 = r2 / (out.residual * out.residual);
                goal = memory.body.tolerance * memory.body.tolerance * b2;
                if (!(largest > 0)) largest = largest_eigenvalue();
                weights = SweepWeights::of(largest);
            }
            if (status < 0 && r2 <= goal) status = CONVERGED;
            if (status < 0 && !(r2 < 0.25 * last)) status = MAX_ITERATIONS;  // rounding errors dominate
            if (status >= 0) break;
            bool broken = false;
            double rz = 0;  // of the iteration before; 0: there is none
            first = last = r2;
            for (int since = 0; r2 > goal && status < 0 && !broken;) {
                const double zr = precondition(r2);
                if (iterations >= most) status = MAX_ITERATIONS;
                broken = !usable(zr) || (way < DIAGONAL && since >= SMOOTH_ENOUGH && !(r2 < first * sqrt(sqrt(goal / first))));
                if (broken || status >= 0) break;
                double sums[4];
                direction(rz > 0 ? (real)(zr / rz) : 0, sums);
                rz = zr;
                ++iterations;
                ++since;
                const double alpha = sums[0] > 0 ? zr / sums[0] : 0;
                broken = !usable(alpha);
                if (!broken) r2 = descend((real)alpha, sums);
            }
            if (broken) {
                last = 1e299;
                if (++way == NO_WAY) status = BREAKDOWN_PRECONDITIONER;
            }
            give();
        }
        if (group.index > 0 || threadIdx.x > 0) return;
        out.status = status;
        out.residual = sqrt(r2 / b2);
        out.iterations += iterations;
        if (way >= DIAGONAL) out.kind = BLOCK_JACOBI, out.fallbacks = 1;
    }
};

extern "C" __global__ void __launch_bounds__(THREADS, PER_PROCESSOR) smoothed(const PcgArguments s) {
    if (*s.unfinished != s.step[0]) return;
    const RowRange range = s.row_ranges[s.initial_range[blockIdx.x]];  // no body is in the pool
    const int k = range.body;
    PcgResult& result = s.results[(s.step[0] % s.capacity) * s.count + k];
    if (result.status != SLOW) return;
    const long long begin = nanoseconds();
    for (int i = threadIdx.x; i < (int)(sizeof(PcgBody) / 4); i += THREADS) ((int*)&memory.body)[i] = ((const int*)(s.bodies + k))[i];
    __syncthreads();
    for (int i = threadIdx.x; i < (int)(sizeof(DevicePlan) / 4); i += THREADS) ((int*)&memory.plan)[i] = ((const int*)memory.body.plan)[i];
    __syncthreads();
    const long long first = 3ll * (memory.body.first + range.begin);
    SmoothedSolver solver = {{range.index, memory.body.blocks, s.exchange_number[k], s.block_sums + 8ll * s.grid * k, s.grid, memory.scratch, memory.totals,
                              (int)threadIdx.x % 32, (int)threadIdx.x / 32},
                             s.b + first, s.y + first, result.iterations > 0 ? nullptr : s.own_vectors + first + 3ll * s.nodes,
                             smoothing_sweeps(memory.body, s.slow[k]), s.largest[k]};
    solver.set_up(s, range);
    PcgResult out = result;  // read by all thread blocks before the first exchange, as the number of the exchange
    const int before = out.iterations;
    solver.solve(out);
    if (range.index > 0 || threadIdx.x > 0) return;
    out.seconds += 1e-9 * (nanoseconds() - begin);
    result = out;
    const bool useless = solver.way > SMOOTHED_FACTOR;
    s.slow[k] = slow_after(memory.body, useless, out.iterations - before, solver.sweeps);
    s.largest[k] = useless ? 0 : solver.largest;
    s.exchange_number[k] = solver.group.number;
}
