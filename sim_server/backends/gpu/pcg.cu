// SPDX-License-Identifier: MIT
// Preconditioned conjugate gradients of all bodies in one persistent launch; steps are numbered as in backends/cpu/native/pcg.h.
//
// A body is solved by a group of thread blocks; small bodies of a large scene form a pool, from which free thread blocks take one
// after the other. Thread blocks exchange values as flag words (block_group.cuh); barriers are needed only at the beginning and end
// of a solve. x and r are updated in the first phase of the preconditioner. |r| after the update is known before, from
// |r|^2 - 2 alpha r.q + alpha^2 q.q, so that the preconditioner is not applied after convergence.
//
// Vectors and A have the type `real`, and so has the residual, for every precision of the preconditioner. No float atomics.
#ifdef ERRORS
#include "iterate_error.cuh"
#ifdef NEWTON_PHASES
#include "bounded_search.cuh"
#define JUDGES  // trials, by the first z of a solve
#endif
#endif
#include "partitioned_inverse.cuh"
#include "clock.cuh"
#ifdef ALONE
#include "pool_order.cuh"
#endif
#include "spmv.cuh"
#ifdef STAGES
#include "stages.cuh"
#endif
#ifdef CONTACT_PASSES
#include "contact_state.cuh"
#endif
#ifdef CORRECTED
#include "correction.cuh"
#endif
#ifdef BUDGETS
#include "step_budget.cuh"
#endif
#ifdef SMOOTHED
#include "smoothing_state.cuh"
#endif

#ifdef ALONE  // d r is written once, after the update, and a barrier stands before it is read; of A p nothing is exchanged
#define HELD &
#else
#define HELD
#endif
#define AT_A_TIME (WARPS > 8 ? 5 : 3)  // entries of a vector
#if defined(ALONE) && WARPS > 8  // 128 registers a thread, and fewer for the chunks under way
#define INVERSE_HELD &
#else
#define INVERSE_HELD
#endif

struct BlockMemory {  // static shared memory of a thread block: data that is the same in all threads needs no registers
    double scratch[3 * WARPS][4], totals[4];
    PcgBody body;
    DevicePlan plan;
    BlockRows rows;
    PartitionedInverse inverse;
    Scale* d;                      // (own, 3) scale of the own degrees of freedom, or null
    real* diagonal;                // (own, 9) inverses of the diagonal blocks
    double peak;                   // largest scale
    int next, bad, rests;
    double b2, goal, quarter, rz;  // of the iteration; all threads write the same values
    PcgResult out;
#ifdef CONTACT_PASSES
    ContactState contact;          // before the solve
    int outcome;                   // ContactPhase after it
#endif
#ifdef CORRECTED
    CorrectionMemory correction;
#endif
#ifdef ERRORS
    double peaks[WARPS + 1];
    IterateError error;
#endif
#ifdef JUDGES
    Search search;
    bool over;
    unsigned first_number;         // of the words of s.z that have the first z of a solve with a factor
#endif
#ifdef BUDGETS
    long long began, deadline;     // of the solve [ns]
    long long looked;              // at the clock, by the first thread of the first thread block
#endif
#ifdef HELPED
    BodyHelp help;
#endif
#ifdef SMOOTHED
    long long slow;                // of the body, as solves before left it
    int limit;                     // iterations after which a solve may go on smoothed
    double first_r2;               // |r|^2 at the start
#endif
};
__shared__ BlockMemory memory;

__device__ __forceinline__ bool usable(double a) { return a > 0 && a < 1e300; }

// 1 / a to 40 bits, in a tenth of the time of a division; enough for alpha and beta.
__device__ __forceinline__ double inverse_of(double a) {
    double y;
    asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(a));
    return y * (2 - a * y);
}

struct PcgSolver {
    const PcgArguments& s;
    BlockGroup group;
    int turn = 0;          // half of inverse.residual that holds d r before the update
    unsigned r_number = 0, q_number = 0, z_number = 0;  // exchanges in which d r, d q and z were written
    bool packed = false;   // positions are those of the inverse
    bool fresh = false;    // inverse.residual holds d r as it will be after the pending update
    bool fetched = false;  // the copy of the inverse into shared memory has begun
    bool arrived = false;  // and is complete
    bool given = false;    // the start is given, and the tolerance is relative to its residual (GIVEN_START of pcg.h)
#ifdef CONTACT_PASSES
    const ContactSolve& pass;
#endif
#ifdef CORRECTED
    const Correction& given_correction;
    bool corrects = false;  // applications are corrected
    int column = -1;        // of V, that the next application makes
    int body = 0;
#endif
#ifdef ERRORS
    double x_change = 0;    // |x - x at the last look|, of the last exchange with it
    bool enough = false;    // the estimated error ends the solve
#endif
#ifdef BUDGETS
    bool spent = false;     // its time is over, as the first thread block has seen
#endif

    __device__ __forceinline__ void set_up(const RowRange& range) {
        const PcgBody& body = memory.body;
        Arena arena = {shared_memory, shared_memory + s.shared};
        PartitionedInverse inverse;
        const bool inverted = body.plan && (body.kind == CHOLESKY || body.probe > 0);
#ifdef HELPED
        inverse.far = inverted ? memory.help.far : 0;
        if (inverse.far && group.index == 0) memory.help.prepare(body.helper);
#endif
        if (inverted) inverse.reserve(&memory.plan, group.index, arena);
        BlockRows rows;
        rows.set_up(s, body, range, arena, inverted, inverted ? inverse.lent : Arena{nullptr, nullptr});
        real* diagonal = arena.take<real>(9 * rows.own);
        if (!diagonal) diagonal = s.diagonal + 9ll * (body.first + rows.begin);
        if (inverted) inverse.set_up(body, group.index, arena);
        if (threadIdx.x == 0) {
            memory.rows = rows;
            memory.inverse = inverse;
            memory.diagonal = diagonal;
            memory.d = rows.scale;
            if (inverted) memory.peak = inverse.scale[inverse.size];
        }
        packed = body.kind == CHOLESKY && body.plan;
#ifdef ALONE
        __syncthreads();
        const bool early = packed && !memory.rests;  // beside the first residual, which may be all that a body at rest needs
        if (early) fetch();
        find_places();  // while A is on its way
        if (early) copies_end<1>();
        else copies_end<0>();
#else
        copies_end<0>();
        __syncthreads();
        if (packed && group.blocks > 1) fetch();  // beside the first residual; many bodies of the pool need only that
        find_places();
#endif
        __syncthreads();
    }

    __device__ __forceinline__ void fetch() {
        memory.inverse.fetch();
        fetched = true;
    }

    // Sets the positions of the values that this block reads: in packed order for the inverse, else in the order of the nodes.
    __device__ __forceinline__ void find_places() {
        const BlockRows& rows = memory.rows;
        for (int k = threadIdx.x; k < rows.halo; k += THREADS) {
            int node = rows.node(k);
            rows.place[k] = packed ? memory.plan.place[node] : 3 * (memory.body.first + node);
#ifdef CUTS
            if (packed && s.at_rest[memory.body.first + node] != 0) rows.place[k] |= APART;
#endif
        }
        __syncthreads();
        if (!packed || !memory.d) return;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) memory.d[k] = memory.inverse.scale[rows.position(k / 3) + k % 3];
    }

    static __device__ __forceinline__ real scale_of(int k) {
        return memory.d ? memory.d[k] : (real)memory.inverse.scale[memory.rows.position(k / 3) + k % 3];
    }

    // Writes d r of an own degree of freedom for all thread blocks.
    __device__ __forceinline__ void publish(int half, int k, real r) const { put_own(residuals(half), k, r); }
    __device__ __forceinline__ void publish_product(int k, real q) const { put_own(memory.inverse.product, k, q); }

    __device__ __forceinline__ void put_own(FlagWord<float>* to, int k, real v) const {
        float scaled = (float)(scale_of(k) * v);
#ifdef CUTS
        if (memory.rows.place[k / 3] & APART) scaled = 0;
#endif
        FlagWord<float>& word = to[memory.rows.position(k / 3) + k % 3];
        word.put(scaled, group.number);
#ifdef HELPED
        if (memory.rows.place[k / 3] & RESIDUAL_FAR) put_far(word, memory.inverse.far, scaled, group.number);
#endif
    }

    // z at entry k of the halo, by what P has made there.
    __device__ __forceinline__ float applied(const BlockRows& rows, int k, float z) const {
#ifdef CORRECTED
        if (corrects) z -= correction_at(rows, k);
#endif
#ifdef CUTS
        if (rows.place[k / 3] & APART) z = 0;
#endif
        return z;
    }

    static __device__ __forceinline__ FlagWord<float>* residuals([[maybe_unused]] int half) {
#ifdef ALONE
        return memory.inverse.residual;
#else
        return memory.inverse.residual + (long long)half * (memory.inverse.size + 32);
#endif
    }

    // 1. r = b - A x for the x of the scene, as a pending update by alpha = 1: x = 0 + 1 x, r = b - 1 (A x). With alpha = 0 the
    // solve starts from zero instead. Returns |r|^2; |b|^2 in `b2`.
    __device__ __forceinline__ double residual(double& b2, [[maybe_unused]] bool first_of_solve) {
        const BlockRows& rows = memory.rows;
        const long long first = memory.body.first, begin = 3 * (first + rows.begin);
#pragma unroll 4
        for (int k = threadIdx.x; k < 3 * rows.halo; k += THREADS)
            rows.values[k] = __ldcg(s.y + 3 * (first + rows.node(k / 3)) + k % 3);
#ifdef ALONE
#pragma unroll 4
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) rows.r[k] = s.b[begin + k];
#endif
        __syncthreads();
#ifdef ERRORS
        const double moved2 = largest2([&](int k) { return rows.values[k] - rows.before[k]; });
#endif
#ifdef CORRECTED
        double mine[3] = {0, 0, 0}, out[3];
        const double large = first_of_solve ? look_for_differences() : 0;
#else
        double mine[2] = {0, 0}, out[2];
#endif
        rows.multiply([&](int node, int c, real qk) {
            const int k = 3 * node + c;
#ifdef ALONE
            const real bk = rows.r[k];
#else
            const real bk = s.b[begin + k];
#endif
            const double rk = (double)bk - (double)qk;
            mine[0] += rk * rk;
            mine[1] += (double)bk * (double)bk;
            rows.x[k] = 0;
            rows.r[k] = bk;
            rows.q[k] = qk;
#ifdef CONTACT_PASSES
            pass.last[begin + k] = given ? (real)rk : -qk;
            if (given && first_of_solve) pass.first[begin + k] = (real)rk;
#endif
#ifndef ALONE
            if (!packed) return;
            publish(turn, k, bk);
            publish(1 - turn, k, (real)rk);  // not b - A x from float words, which near the solution would be rounding errors
#endif
        });
        r_number = group.number;
        into_three<2>(mine);
#ifdef CORRECTED
        if (threadIdx.x % 32 == 0) mine[2] = large;
#ifdef ERRORS
        sums_and_change<3, 3>(mine, out, moved2);
#else
        group.sums<3, 3>(mine, out);
#endif
        if (first_of_solve) memory.correction.count = (int)out[2];  // the same in all threads
#elif defined(ERRORS)
        sums_and_change<2, 3>(mine, out, moved2);
#else
        group.sums<2, 3>(mine, out);
#endif
        b2 = out[1];
        return out[0];
    }

    // Sums of the lanes that had entries of a product into lanes 0 to 2.
    template <int N>
    static __device__ __forceinline__ void into_three(double mine[N]) {
#ifdef ALONE
        for (int n = 0; n < N; ++n) {
            for (int k = 16; k; k >>= 1) mine[n] += __shfl_xor_sync(ALL, mine[n], k);
            if (threadIdx.x % 32) mine[n] = 0;
        }
#else
        static_assert(SLAB_ROWS <= 4 && TOGETHER <= 4, "lanes 0 to 11 have sums");
        for (int n = 0; n < N; ++n) {
            mine[n] += __shfl_down_sync(ALL, mine[n], 6);
            mine[n] += __shfl_down_sync(ALL, mine[n], 3);
        }
#endif
    }

#ifdef ERRORS
    // Largest square of a vector at an own node of this thread. at(k): its entry k.
    template <class At>
    static __device__ __forceinline__ double largest2(At at) {
        double most = 0;
        for (int k = 3 * threadIdx.x; k < 3 * memory.rows.own; k += 3 * THREADS) {
            const double a[3] = {(double)at(k), (double)at(k + 1), (double)at(k + 2)};
            most = fmax(most, a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
        }
        return most;
    }

    // Sums over the group as BlockGroup.sums, and `x_change` from this thread's part of it.
    template <int N, int LANES>
    __device__ __forceinline__ void sums_and_change(const double mine[N], double out[N], double moved2) {
        group.sums<N, LANES, true>(mine, out, false, &moved2);
        x_change = sqrt(moved2);
    }

    // After an application and the next search direction: notes z, and keeps x where it is to be looked at. Returns whether the solve ends.
    __device__ __forceinline__ bool ends_by(int kind, double zr, double r2, double size) {
        IterateError& error = memory.error;
        if (threadIdx.x == 0) error.apply(kind, zr, r2, size, x_change);
        __syncthreads();
        enough = error.enough;
        const BlockRows& rows = memory.rows;
        if (error.looks)
            for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) rows.before[k] = rows.x[k];
        return enough;
    }

    // After an iteration: whether the solve ends at x + alpha p.
    __device__ __forceinline__ void look_ahead(real alpha, double r2) {
        IterateError& error = memory.error;
        const BlockRows& rows = memory.rows;
        if (threadIdx.x == 0) error.move((double)alpha, r2);
        __syncthreads();
        if (!error.near) return;
        double none[1] = {0};
        sums_and_change<1, 1>(none, none, largest2([&](int k) { return rows.x[k] + alpha * rows.values[k] - rows.before[k]; }));
        if (threadIdx.x == 0) error.enough = error.is_enough(r2, x_change, true);
        __syncthreads();
        enough = error.enough;
    }

    // Sets what the estimate may do. r2, b2: squares of the residual at the start and of b.
    __device__ __forceinline__ void bound(double r2, double b2) const {
        if (threadIdx.x > 0) return;
        IterateError& error = memory.error;
        error.b2 = given ? r2 : b2;
#ifdef CONTACT_PASSES
        const ContactState& c = memory.contact;
        if (memory.outcome == PASSED) error.position = 0;
        if (memory.outcome == LAST_PASSED) error.limit2 = WITHIN * WITHIN * pass.tolerance * pass.tolerance * c.given2;
#endif
    }
#endif

#ifdef JUDGES
    // Judges the last trial by z = p = P^-1 b, |z| = size. Returns whether the search ends, with x as the solution; else sets the tolerance.
    __device__ __forceinline__ bool ends_search(int kind, double size) {
        const PcgBody& body = memory.body;
        if (threadIdx.x == 0) {
            const bool judges = body.position > 0 || memory.search.phase != SOLVE;
            memory.over = judges && ends_by_start(memory.search, body, kind, size);
            const double tolerance = solve_tolerance(memory.search, body.tolerance, kind);
            const double useful = body.position > 0 ? fmax(tolerance, USEFUL) : tolerance;
            memory.goal = tolerance * tolerance * memory.b2;
            memory.quarter = memory.b2 * sqrt(useful);
        }
        __syncthreads();
        if (memory.over) give(is_added(memory.search, body), 1);
        else if (memory.search.applied) keep_first();
        return memory.over;
    }

#ifdef BUDGETS
    static __device__ __forceinline__ bool first_of_step() { return memory.search.linearizations == 0; }
#endif

    // Keeps z = p where solves without a factor have theirs.
    __device__ __forceinline__ void keep_first() const {
        const BlockRows& rows = memory.rows;
        if (threadIdx.x == 0) memory.first_number = group.number;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS)
            s.z[3ll * (memory.body.first + rows.begin) + k].put(rows.values[k], group.number);
    }

    // At the end, with the solution in rows.values: how far it is from the first z.
    __device__ __forceinline__ void compare_with_first(double solve_error) {
        const BlockRows& rows = memory.rows;
        auto difference = [&](int k) {
            real z;
            const bool kept = s.z[3ll * (memory.body.first + rows.begin) + k].get(z, memory.first_number);
            return rows.values[k] - (kept ? z : 0);
        };
        double none[1] = {0}, out[1], solution2 = largest2([&](int k) { return rows.values[k]; }), difference2 = largest2(difference);
        group.sums<1, 1, true>(none, out, false, &solution2);
        group.sums<1, 1, true>(none, out, false, &difference2);
        if (threadIdx.x == 0)
            note_left(memory.search, sqrt(solution2), sqrt(difference2), memory.error.first_size, solve_error, memory.body.dx_dv);
    }
#endif

#if defined(BUDGETS) && !defined(JUDGES)
    static __device__ __forceinline__ bool first_of_step() { return true; }
#endif

    // 7. 8. 2. p = z + beta p, q = A p; sums p.q, r.q, q.q, r.r
#ifdef ERRORS
    // size: |z|
    __device__ __forceinline__ void direction(real beta, double out[4], double& size) {
#else
    __device__ __forceinline__ void direction(real beta, double out[4]) {
#endif
        const BlockRows HELD rows = memory.rows;
        if (packed) rows.form(memory.inverse.z, z_number, beta, [&](int k, float z) { return applied(rows, k, z); });
        else rows.form(s.z, z_number, beta, [](int, real z) { return z; });
#ifdef ERRORS
        double z2 = largest2([&](int k) { return rows.q[k]; });
        __syncthreads();
#endif
        double mine[4] = {0, 0, 0, 0};
        rows.multiply([&](int node, int c, real q) {
            const int k = 3 * node + c;
            rows.keep_product(k, q, mine);
#ifndef ALONE
            if (packed) publish_product(k, q);
#endif
        });
        q_number = group.number;
        into_three<4>(mine);
#ifdef ERRORS
        group.sums<4, 3, true>(mine, out, false, &z2);
        size = sqrt(z2);
#else
        group.sums<4, 3>(mine, out);
#endif
    }

#ifdef ALONE
    // x += alpha p, r -= alpha q, and d r for the inverse. Loads of x travel together, as it may be in memory.
    __device__ __forceinline__ void update(real alpha) const {
        const BlockRows HELD rows = memory.rows;
        const int count = 3 * rows.own;
        for (int first = threadIdx.x; first < count; first += AT_A_TIME * THREADS) {
            real x[AT_A_TIME];
            if (alpha != 0)
#pragma unroll
                for (int n = 0; n < AT_A_TIME; ++n) x[n] = rows.x[min(first + n * THREADS, count - 1)];
#pragma unroll
            for (int n = 0; n < AT_A_TIME; ++n) {
                const int k = first + n * THREADS;
                if (k >= count) break;
                real r = rows.r[k];
                if (alpha != 0) {
                    r -= alpha * rows.q[k];
                    rows.r[k] = r;
                    rows.x[k] = x[n] + alpha * rows.values[k];
                }
                if (packed) publish(0, k, r);
            }
        }
    }
#endif

    // 3. 4. 5. 6. x += alpha p, r -= alpha q, z = P^-1 r; returns z . r. r2: |r|^2 after the update.
    __device__ __forceinline__ double precondition(int kind, real alpha, double r2) {
        [[maybe_unused]] const BlockRows HELD rows = memory.rows;
#ifdef ALONE
#ifdef CORRECTED
        if (column >= 0) {
            for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
                const CorrectionMemory& m = memory.correction;
                publish(0, k, 3 * (m.node[column / 3] - rows.begin) + column % 3 == k);
            }
        } else
#endif
            update(alpha);
#else
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
#ifdef CORRECTED
            if (column >= 0) {
                const CorrectionMemory& m = memory.correction;
                publish(1 - turn, k, 3 * (m.node[column / 3] - rows.begin) + column % 3 == k);
                continue;
            }
#endif
            real r = rows.r[k];
            if (alpha != 0) {
                const real x = rows.x[k] + alpha * rows.values[k];
                r -= alpha * rows.q[k];
                rows.r[k] = r;
                rows.x[k] = x;
            }
            if (packed) publish(1 - turn, k, r);
        }
#endif
#ifdef BUDGETS
        double mine[2], zr[2];
#else
        double mine[1], zr[1];
#endif
        z_number = group.number;
        if (kind == CHOLESKY) {
            mine[0] = by_inverse(alpha, r2);
#ifdef CORRECTED
            if (column >= 0) keep_column();
#endif
        } else {
            __syncthreads();
            mine[0] = by_diagonal(kind);
        }
        for (int k = 16; k; k >>= 1) mine[0] += __shfl_xor_sync(ALL, mine[0], k);
#ifdef BUDGETS
        mine[1] = group.index == 0 && threadIdx.x == 0 && looks_at_clock();
        sums_and_change<2, 1>(mine, zr, largest2([&](int k) { return rows.x[k] - rows.before[k]; }));
        spent = zr[1] > 0;
#elif defined(ERRORS)
        sums_and_change<1, 1>(mine, zr, largest2([&](int k) { return rows.x[k] - rows.before[k]; }));
#else
        group.sums<1, 1>(mine, zr);
#endif
#ifdef HELPED
        if (kind == CHOLESKY && memory.inverse.far) zr[0] += memory.help.sum(group);
#endif
        return zr[0];
    }

#ifdef BUDGETS
    static __device__ __forceinline__ bool looks_at_clock() {
        const long long now = nanoseconds(), iteration = now - memory.looked;
        memory.looked = now;
        return is_spent(memory.body, memory.began, memory.deadline, now, iteration);
    }
#endif

    __device__ __forceinline__ double by_diagonal(int kind) const {
        const BlockRows HELD rows = memory.rows;
        double mine = 0;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            const real *r = rows.r + k / 3 * 3, *v = memory.diagonal + 3 * k;
            const real z = kind == NONE ? rows.r[k] : v[0] * r[0] + v[1] * r[1] + v[2] * r[2];
            s.z[3ll * (memory.body.first + rows.begin) + k].put(z, group.number);
            mine += (double)z * (double)rows.r[k];
        }
        return mine;
    }


    __device__ __forceinline__ double by_inverse(real alpha, double r2) {
        const PartitionedInverse INVERSE_HELD inverse = memory.inverse;
        // a power of two that scales d r below 1, for the small range of float16
        const float unit = unit_for(r2 * memory.peak * memory.peak);
        ResidualSource from = {residuals(turn), r_number, q_number, fresh ? 0 : (float)alpha};  // the update is being applied
        double mine = 0;
#ifdef CORRECTED
        if (column >= 0) from = {residuals(1 - turn), group.number, 0, 0};  // the update is left as it is
        else fresh = false;
#else
        fresh = false;
#endif
#ifdef ALONE
        from = {residuals(0), group.number, 0, 0};
        __syncthreads();  // it is published just before
#endif
        if (!fetched) fetch();
        if (!arrived) copies_end<0>();
#ifdef ALONE
        if (!arrived) __syncthreads();  // for what other threads have copied
        PartitionedInverse::Stream stream;
        inverse.open(stream);
#endif
        arrived = true;
#ifdef HELPED
        if (inverse.far && group.index == 0)
            memory.help.apply(memory.body.helper, from.r == residuals(1), from.r_number, from.q_number, from.alpha, 1 - turn, group.number, unit);
#endif
        for (int phase = 0; phase < inverse.phases; ++phase) {
            inverse.gather(phase, from, group.number, unit);
            __syncthreads();
#ifdef ALONE
            mine += inverse.multiply(phase, from, group.number, unit, stream);
#else
            mine += inverse.multiply(phase, from, group.number, unit);
#endif
            from = {residuals(1 - turn), group.number, 0, 0};
#ifdef ALONE
            if (phase + 1 < inverse.phases) __syncthreads();  // the vector has been read, and words are in order
#endif
        }
#ifdef CORRECTED
        if (column >= 0) return mine;
#endif
        turn = 1 - turn;
        r_number = group.number;
        return mine;
    }

#ifdef CORRECTED
    __device__ __forceinline__ const float* correction_row(int node) const {
        return given_correction.columns + 3ll * (memory.body.first + node) * given_correction.width;
    }

    // What the correction takes off z, by entry of the halo.
    __device__ __forceinline__ float correction_at(const BlockRows& rows, int k) const {
        return taken_off(memory.correction, correction_row(rows.node(k / 3)) + k % 3 * given_correction.width);
    }

    // Compares the own nodes' blocks with those that the factor knows, and without contact keeps what springs add to this matrix. Returns
    // the number of large differences of this warp's nodes.
    __device__ __forceinline__ double look_for_differences() const {
        const Correction& c = given_correction;
        const BlockRows& rows = memory.rows;
        const long long step = s.step[0], then = memory.body.factor_step;
        bool known = packed && then >= 0 && then < step;
#ifdef CONTACT_PASSES
        known &= memory.contact.phase != CHOOSE_START;
#endif
        double large = 0;
        for (int k = threadIdx.x; k < rows.own; k += THREADS) {
            const int node = memory.body.first + rows.begin + k;
            double spring = 0, share = 0;
            if (c.spring) {
                const double now = c.spring_scale * c.spring[node];
#ifndef CONTACT_PASSES
                note_spring(c.springs[node], step, now);
#endif
                if (known) spring = spring_difference(c.springs[node], then, now);
            }
            if (!known) continue;
#ifdef CUTS
            if (rows.place[k] & APART) {
                __stcg(c.share + node, 0.0f);
                continue;
            }
#endif
            const int pair = c.pair && step - then < HISTORY ? c.pair[node] : -1;
            if (spring != 0 || pair >= 0) {
                int at = rows.row_start[k] - rows.base;
                while ((rows.columns[at] & COLUMN) != k) ++at;
                double difference[6];
                share = difference_of(c, pair, spring, rows.blocks + 9ll * at, then, memory.body.planes, difference);
                if (share > 0)
                    for (int i = 0; i < 6; ++i) __stcg(c.difference + 6ll * node + i, difference[i]);
            }
            __stcg(c.share + node, (float)share);
            large += (float)share >= (float)LEAST_SHARE;
        }
        for (int k = 16; k; k >>= 1) large += __shfl_xor_sync(ALL, large, k);
        return large;
    }

    // Chooses the nodes to correct; column: of V, to be made first. Returns whether there is anything to correct.
    __device__ __forceinline__ bool begin_correction() {
        CorrectionMemory& m = memory.correction;
        const Correction& c = given_correction;
        const int first = memory.body.first;
        if (m.count == 0 || m.count > c.capacity) return false;
        group.barrier();  // the differences are written
        if (m.step != memory.body.factor_step && threadIdx.x == 0) {
            m.step = memory.body.factor_step;
            m.used = m.usable = 0;
        }
        __syncthreads();
        choose_slots(m, c.share + first, memory.body.nodes, c.capacity);
        compare_blocks(m, c.share + first, c.difference + 6ll * first, c.bodies[body].block);
        for (int k = threadIdx.x; k < m.used; k += THREADS) {
            m.place[k] = memory.plan.place[m.node[k]];
#ifdef HELPED
            m.place[k] &= ~RESIDUAL_FAR;
#endif
        }
        __syncthreads();
        column = m.fresh_count ? 3 * m.fresh[0] : -1;
        return true;
    }

    // Keeps the own rows of a column of V.
    __device__ __forceinline__ void keep_column() const {
        const BlockRows& rows = memory.rows;
#ifdef ALONE
        __syncthreads();
#endif
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            const FlagWord<float>* z = memory.inverse.z + rows.position(k / 3) + k % 3;
            float value;
            for (unsigned spins = 0; keep_polling(!z->get(value, group.number), spins);) {}
            __stcg(const_cast<float*>(correction_row(rows.begin + k / 3)) + k % 3 * given_correction.width + column, value);
        }
    }

    // Goes on to the column after the `made`-th.
    __device__ __forceinline__ void next_column(int made) {
        const CorrectionMemory& m = memory.correction;
        column = made < 3 * m.fresh_count ? 3 * m.fresh[made / 3] + made % 3 : -1;
    }

    // Makes M where V or C has changed. The first thread block takes the memory of its part of the inverse, if that is large enough.
    __device__ __forceinline__ void finish_correction() {
        CorrectionMemory& m = memory.correction;
        const Correction& c = given_correction;
        if (m.changed) {
            group.barrier();  // V is complete, and no block compares with the old C
            if (group.index == 0) {
                const long long numbers = scratch_size(m.used), inverse_bytes = 512ll * memory.inverse.near;
                copies_end<0>();
                __syncthreads();
                double* scratch = (double*)memory.inverse.kept;
                if (8 * numbers > inverse_bytes) scratch = c.scratch + body * scratch_size(c.capacity);
                make_inner(m, c.share + memory.body.first, c.difference + 6ll * memory.body.first, correction_row(0), c.width, c.bodies[body].block,
                           c.inner + (long long)body * c.width * c.width, scratch);
                if (threadIdx.x == 0) __stcg(&c.bodies[body].usable, m.ordered);
                fetched = arrived = false;
            }
            group.barrier();
            if (threadIdx.x == 0) m.usable = __ldcg(&c.bodies[body].usable);
            __syncthreads();
        }
        corrects = m.usable;
    }

    // s = M t, for t = z at the corrected nodes; returns what the correction takes off z . r.
    __device__ __forceinline__ double correct() {
        CorrectionMemory& m = memory.correction;
        for (int k = threadIdx.x; k < 3 * m.used; k += THREADS) {
            const FlagWord<float>* z = memory.inverse.z + m.place[k / 3] + k % 3;
            float value;
            for (unsigned spins = 0; keep_polling(!z->get(value, z_number), spins);) {}
            m.t[k] = value;
        }
        __syncthreads();
        return small_product(m, given_correction.inner + (long long)body * given_correction.width * given_correction.width,
                             given_correction.width);
    }

    // Keeps nodes and state for later solves.
    __device__ __forceinline__ void keep_correction() const {
        const CorrectionMemory& m = memory.correction;
        CorrectedBody& to = given_correction.bodies[body];
        for (int k = threadIdx.x; k < m.used; k += THREADS) to.node[k] = m.node[k];
        if (threadIdx.x == 0) { to.step = m.step; to.used = m.used; to.usable = m.usable; }
    }
#endif

    __device__ __forceinline__ void invert_diagonal(bool whole) const {
        const BlockRows& rows = memory.rows;
        for (int node = threadIdx.x; node < rows.own; node += THREADS) {
            int k = rows.row_start[node] - rows.base;
            while ((rows.columns[k] & COLUMN) != node) ++k;
            invert3(rows.blocks + 9ll * k, whole, memory.diagonal + 9 * node);
        }
    }

    // Writes x + alpha p to the scene (keep = 0: zero), then a barrier.
    __device__ __forceinline__ void give(real keep, real alpha) {
        const BlockRows& rows = memory.rows;
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            const real x = keep != 0 ? rows.x[k] + (alpha != 0 ? alpha * rows.values[k] : 0) : 0;
            __stcg(s.y + 3ll * (memory.body.first + rows.begin) + k, x);
        }
        group.barrier();
    }

#ifdef SMOOTHED
    // Leaves a solve before its first iteration to smoothed.cu, with r where that finds it. from_start: x is that of the scene, else zero.
    __device__ __forceinline__ void leave(bool from_start, double r2) {
        const BlockRows& rows = memory.rows;
        real* r = s.own_vectors + 3ll * (memory.body.first + rows.begin) + 3ll * s.nodes;
        real* x = s.y + 3ll * (memory.body.first + rows.begin);
#pragma unroll 1
        for (int k = threadIdx.x; k < 3 * rows.own; k += THREADS) {
            r[k] = rows.r[k] - (from_start ? rows.q[k] : 0);
            if (!from_start) x[k] = 0;
        }
        memory.out.status = SLOW;
        memory.out.residual = sqrt(r2 / memory.b2);
    }
#endif

    // Continues with another preconditioner from the present residual.
    __device__ __forceinline__ void change(int kind) {
        group.barrier();
        packed = kind == CHOLESKY;
        fresh = false;
        find_places();
        __syncthreads();
        if (packed) {
            for (int k = threadIdx.x; k < 3 * memory.rows.own; k += THREADS) publish(turn, k, memory.rows.r[k]);
            r_number = group.number;
            group.barrier();
        } else {
            invert_diagonal(true);
        }
    }

#ifdef CONTACT_PASSES
    // Whether there is nothing to solve; else the goal of a pass. r2: |r|^2 at the start.
    __device__ __forceinline__ bool ends_before(double r2) {
        const ContactState& c = memory.contact;
        if (c.phase == CHOOSE_START) {
            memory.outcome = memory.body.warm_start && r2 < c.zero2 ? FROM_START : FROM_ZERO;
            if (memory.outcome == FROM_ZERO) give(0, 0);
            return true;
        }
        if (c.phase == WITHOUT) return false;
        const int outcome = outcome_of(c, pass, r2, memory.goal);
        memory.outcome = outcome;
        if (outcome == ENDED) memory.out.residual = c.given2 > 0 ? sqrt(r2 / c.given2) : 0;
        if (outcome == PASSED) memory.goal = early_goal(c, pass, r2, memory.goal);
        return outcome == ENDED;
    }
#endif

    __device__ __forceinline__ void solve();
};

// One loop in which each part occurs once: the code would not fit into the instruction cache if parts were inlined twice.
__device__ __forceinline__ void PcgSolver::solve() {
    const PcgBody& body = memory.body;
    PcgResult& out = memory.out;
    int kind = body.kind == CHOLESKY && !body.plan ? BLOCK_JACOBI : body.kind;
    out = {0, 0, -1, 0, CONVERGED, kind, body.kind, 0, -1, body.probe};
    double r2 = 0, alpha = 0, last = 1e300;
    int stop = CONVERGED, iterations = 0;
    bool begun = false, measure = true, restart = true, switched = false;
#ifdef CORRECTED
    bool prepares = false;
    int made = 0;  // columns of V
#endif
    if (kind == JACOBI || kind == BLOCK_JACOBI) invert_diagonal(kind == BLOCK_JACOBI);
    for (;;) {
        if (measure) {  // the true residual
            double bb;
#ifdef ERRORS
            const double found = r2;
#endif
            r2 = residual(bb, !begun);
            measure = false;
            alpha = 1;
            restart = true;
            if (!begun) {
                begun = true;
#ifdef CONTACT_PASSES
                const bool refused = !isfinite(bb) || (given && !isfinite(r2));
                if (refused) bb = r2 = bb + r2;
                else if (given) bb = memory.contact.given2;
#else
                const bool refused = !isfinite(bb);
                if (given && !refused) bb = r2;
#endif
                memory.b2 = bb;
                if (memory.rests && bb > 0 && !refused) {  // b is rounding error: the solution stays as it is, the body rests
                    out.residual = sqrt(r2 / bb);
                    out.at_rest = 1;
                    return;
                }
                memory.goal = body.tolerance * body.tolerance * bb;
#ifdef CONTACT_PASSES
                if (!refused && ends_before(r2)) return;
#endif
#ifdef ERRORS
                bound(r2, bb);
#endif
                if ((!given || refused) && (!body.warm_start || !(r2 < bb))) { alpha = 0; r2 = bb; }
                else fresh = true;
#ifdef ERRORS
                const double end = body.position > 0 ? fmax(memory.goal, USEFUL * USEFUL * bb) : memory.goal;
#else
                const double end = memory.goal;
#endif
                memory.quarter = r2 * sqrt(sqrt(end / r2));
#ifdef SMOOTHED
                memory.first_r2 = r2;
#endif
                if (refused || r2 <= memory.goal) {
                    if (refused) {
                        out.status = NOT_FINITE;
                        out.bad_node = first_bad_node(memory.body, s.b, memory.bad);
                    }
                    if (alpha == 0) give(refused, (real)(0 * bb));  // NaN: `advance` restores the body; else the scene has x already
                    out.residual = refused ? bb : bb > 0 ? sqrt(r2 / bb) : 0;
                    return;
                }
#ifdef CORRECTED
                prepares = kind == CHOLESKY && begin_correction();
#endif
            } else {
#ifdef ERRORS
                if (enough && r2 <= LOST_DIGITS * found) memory.goal = fmax(memory.goal, r2);  // it is exact enough
                enough = false;
                if (threadIdx.x == 0) out.solve_error = memory.error.told(r2, x_change);
#ifdef JUDGES
                if (threadIdx.x == 0) memory.search.factor_scale = memory.error.scale(r2, x_change, memory.search.factor_scale);
                if (memory.search.applied) compare_with_first(out.solve_error);
#endif
#endif
                if (stop == CONVERGED && r2 > memory.goal && !(r2 < 0.25 * last)) stop = MAX_ITERATIONS;  // rounding errors dominate
                if (stop != CONVERGED || r2 <= memory.goal) {
                    out.status = stop;
                    out.residual = sqrt(r2 / memory.b2);
                    return;
                }
                last = r2;  // the recursive residual was smaller than the true one
                fresh = true;
            }
            if (fresh) turn = 1 - turn;
        }
        stop = r2 <= memory.goal ? CONVERGED : -1;
#ifdef ERRORS
        if (enough) stop = CONVERGED;
#endif
#ifdef SMOOTHED
#ifdef CORRECTED
        const bool alone = !prepares && !corrects;
#else
        constexpr bool alone = true;
#endif
        if (stop < 0 && iterations == memory.limit && kind == CHOLESKY && alone && is_slow(body.nodes, iterations, memory.first_r2, r2, memory.goal)) {
            stop = SLOW;
            if (iterations == 0) {
                leave(alpha != 0, r2);
                return;
            }
        }
#endif
        if (stop < 0) {
#ifdef CORRECTED
            if (prepares && column < 0) {
                prepares = false;
                finish_correction();
            }
            double zr = precondition(kind, (real)alpha, column < 0 ? r2 : 1.0);
            if (column >= 0) {
                next_column(++made);
                continue;
            }
            if (corrects && kind == CHOLESKY) {
                const double corrected = zr - correct();
                corrects = usable(corrected);
                if (corrects) zr = corrected;
                else restart = true;  // without the correction
                if (!corrects && threadIdx.x == 0) memory.correction.usable = 0;
            }
#else
            const double zr = precondition(kind, (real)alpha, r2);
#endif
            alpha = 0;
            int other = -1;
            if (!usable(zr)) stop = BREAKDOWN_PRECONDITIONER;
            else if (iterations == body.max_iterations) stop = MAX_ITERATIONS;
            else if (kind == CHOLESKY && body.max_iterations >= ENOUGH && iterations == body.max_iterations / 2 && !(r2 < memory.quarter))
                stop = BREAKDOWN_PRECONDITIONER;  // not a quarter of the way, see pcg.h
            if (stop == BREAKDOWN_PRECONDITIONER && kind == CHOLESKY) {  // a useless factor: continue with block Jacobi
                other = BLOCK_JACOBI;
                out.fallbacks = 1;
            } else if (stop < 0 && body.probe > 0 && iterations == body.probe && body.plan && kind >= BLOCK_JACOBI && !switched) {
                other = kind == CHOLESKY ? BLOCK_JACOBI : CHOLESKY;
                switched = true;
            }
            if (other >= 0) {
                kind = out.kind = other;
                change(kind);
                restart = true;
                continue;
            }
#ifdef BUDGETS
            if (stop < 0 && ends_by_budget(body, spent, iterations, first_of_step())) stop = BUDGET;
#endif
            if (stop < 0) {
                double sums[4];
#ifdef ERRORS
                double size;
                direction(restart ? 0 : (real)(zr * inverse_of(memory.rz)), sums, size);
#ifdef JUDGES
                if (iterations == 0 && memory.search.linearizations > 0 && ends_search(kind, size)) return;
#endif
                if (ends_by(kind, zr, r2, size)) continue;
#else
                direction(restart ? 0 : (real)(zr * inverse_of(memory.rz)), sums);
#endif
                memory.rz = zr;
                restart = false;
                out.iterations = ++iterations;
                stop = BREAKDOWN_MATRIX;
                if (sums[0] > 0) {
                    alpha = (real)(zr * inverse_of(sums[0]));
                    r2 = fmax(0.0, sums[3] - 2 * alpha * sums[1] + alpha * alpha * sums[2]);
#ifdef ERRORS
                    if (usable(alpha) && isfinite(r2)) look_ahead((real)alpha, r2);
#endif
                    if (usable(alpha) && isfinite(r2)) continue;
                    alpha = 0;
                }
            }
        }
        give(1, (real)alpha);
        measure = true;
    }
}

#ifdef STAGES  // an attempt of a Rosenbrock-W step (stages.cuh): solve only the bodies that make it
#define KIND_OF_STEP , const StageSolve stage
#define STAGE , stage
#elif defined(NEWTON_PHASES)  // several linearizations a step: solve only the bodies in phase 0 (newton.cu)
#ifdef JUDGES
#define KIND_OF_STEP , const int* __restrict__ active, const int* __restrict__ phase, Search* search
#define STAGE , search
#else
#define KIND_OF_STEP , const int* __restrict__ active, const int* __restrict__ phase
#define STAGE
#endif
#elif defined(CONTACT_PASSES)  // contact: in the first solve of a step all bodies, then those that are READY (contact_state.cuh)
#define KIND_OF_STEP , const ContactSolve pass
#define STAGE , pass
#else
#define KIND_OF_STEP
#define STAGE
#endif
#ifdef CORRECTED  // factors are corrected (correction_state.cuh)
#define CORRECTION , const Correction correction
#define CORRECTION_PARAMETER , const Correction& correction
#define CORRECTED_BY , correction
#else
#define CORRECTION
#define CORRECTION_PARAMETER
#define CORRECTED_BY
#endif
#ifdef HELPED  // another device applies a part of the inverses (helper.cuh)
#define HELP , const Help help
#define HELP_PARAMETER , const Help& help
#define HELPED_BY , help
#else
#define HELP
#define HELP_PARAMETER
#define HELPED_BY
#endif
#ifdef STAGES
#define STAGE_PARAMETER , const StageSolve& stage
#elif defined(JUDGES)
#define STAGE_PARAMETER , Search* search
#elif defined(CONTACT_PASSES)
#define STAGE_PARAMETER , const ContactSolve& pass
#else
#define STAGE_PARAMETER
#endif

__device__ __forceinline__ void solve_body(const PcgArguments& s, const RowRange& range STAGE_PARAMETER CORRECTION_PARAMETER HELP_PARAMETER) {
    const int k = range.body;
    for (int i = threadIdx.x; i < (int)(sizeof(PcgBody) / 4); i += THREADS) ((int*)&memory.body)[i] = ((const int*)(s.bodies + k))[i];
    if (threadIdx.x == THREADS - 1) memory.rests = s.moving[k] == 0;
#ifdef SMOOTHED
    if (threadIdx.x == THREADS - 33) memory.slow = s.slow[k];  // the warp before
#endif
#ifdef SPLITS
    __syncthreads();
    if (threadIdx.x == 0 && memory.body.factor_step < s.split_step[k]) memory.body.plan = nullptr;  // of another pattern
#endif
#ifdef CONTACT_PASSES
    if (threadIdx.x == 0) memory.contact = pass.state[k];
#endif
#ifdef JUDGES
    for (int i = threadIdx.x; i < (int)(sizeof(Search) / 4); i += THREADS) ((int*)&memory.search)[i] = ((const int*)(search + k))[i];
#endif
    __syncthreads();
#ifdef CONTACT_PASSES
    if (threadIdx.x == 0) {
        memory.outcome = SOLVED;
        if (memory.contact.phase != WITHOUT) memory.rests = 0;
        if (memory.contact.phase == READY) memory.body.probe = 0;
    }
#endif
    if (memory.body.plan)
        for (int i = threadIdx.x; i < (int)(sizeof(DevicePlan) / 4); i += THREADS) ((int*)&memory.plan)[i] = ((const int*)memory.body.plan)[i];
#ifdef CORRECTED
    for (int i = threadIdx.x; i < MOST_CORRECTED; i += THREADS) memory.correction.node[i] = correction.bodies[k].node[i];
    if (threadIdx.x == 0) {
        memory.correction.step = correction.bodies[k].step;
        memory.correction.used = correction.bodies[k].used;
        memory.correction.usable = correction.bodies[k].usable;
    }
#endif
#ifdef HELPED
    if (threadIdx.x == 0) memory.help.begin(help, k, memory.body);
#endif
#ifdef SMOOTHED
    if (threadIdx.x == 0) memory.limit = smoothing_limit(memory.body, memory.slow);
#endif
    __syncthreads();
    const long long begin = nanoseconds();
#ifdef ERRORS
    if (threadIdx.x == 0) {
#ifdef STAGES
        const double dt = memory.body.dx_dv / ROS2_GAMMA;
        memory.error.begin(memory.body.position, memory.body.trust, dt);
        if (stage.form != EULER) memory.error.of_stage(stage.first_of_attempt);
#else
        memory.error.begin(memory.body.position, memory.body.trust, memory.body.dx_dv);
#endif
#ifdef NEWTON_PHASES
        memory.error.position *= LINEAR_SHARE;
        memory.body.tolerance = first_tolerance(memory.search, memory.body);
#endif
    }
#endif
#ifdef BUDGETS
    if (threadIdx.x == 0) {
        double reserve = 0;
#ifdef JUDGES
        TrialClock& clock = s.clocks[k];
        const bool later = memory.search.linearizations > 0;
        memory.over = false;
        memory.body.budget = budget_left(memory.body.budget, memory.search.iterations);
        reserve = seconds_after_solve(clock);
        if (later && range.index == 0) clock.blocks = 1e-9 * (begin - clock.decided);
#endif
        memory.began = memory.looked = begin;
        memory.deadline = deadline_of(memory.body, __ldcg(s.begun), reserve);
    }
#endif
    PcgSolver solver = {s, {range.index, memory.body.blocks, s.exchange_number[k], s.block_sums + 8ll * s.grid * k, s.grid, memory.scratch, memory.totals,
                         (int)threadIdx.x % 32, (int)threadIdx.x / 32
#ifdef ERRORS
                         , s.block_sums + (8ll * s.count + 2 * k) * s.grid, memory.peaks
#endif
                        }
#ifdef CONTACT_PASSES
                        , 0, 0, 0, 0, false, false, false, false, memory.contact.phase == READY, pass
#endif
#if defined(CORRECTED) && defined(CONTACT_PASSES)
                        , correction
#elif defined(CORRECTED)
                        , 0, 0, 0, 0, false, false, false, false, false, correction
#endif
    };
#ifdef STAGES
    solver.given = stage.form == ITERATE;
#endif
#ifdef CORRECTED
    solver.body = k;
#endif
    solver.set_up(range);
    solver.solve();
#ifdef CORRECTED
    if (range.index == 0) solver.keep_correction();
#endif
#ifdef HELPED
    if (range.index == 0) memory.help.end();
#endif
#ifdef JUDGES
    if (range.index == 0 && threadIdx.x == 0) search[k] = memory.search;  // all thread blocks have read it
#endif
    if (range.index == 0 && threadIdx.x == 0) {
        PcgResult out = memory.out;
        const long long end = nanoseconds();
        out.seconds = 1e-9 * (end - begin);
#if defined(BUDGETS) && defined(JUDGES)
        s.clocks[k].solved = end;
        if (memory.over) s.clocks[k].judging = out.seconds;
#endif
        if (memory.body.plan && (out.asked == CHOLESKY || out.kind == CHOLESKY || out.fallbacks)) out.factor_step = memory.body.factor_step;
        PcgResult& result = s.results[(s.step[0] % s.capacity) * s.count + k];
#ifdef STAGES
        if (stage.first_of_step) result = no_solve(memory.body);
        if (stage.first_of_attempt) { result.status = CONVERGED; result.bad_node = -1; }
#ifdef ERRORS
        if (stage.first_of_attempt) result.solve_error = 0;
#endif
        add_solve(result, out);
#elif defined(CONTACT_PASSES)
        note_pass(pass.state[k], pass, memory.outcome, result, out);
#else
        result = out;
#endif
#ifdef SMOOTHED
        if (out.status == SLOW) *s.unfinished = s.step[0];
#endif
        s.exchange_number[k] = solver.group.number;  // read by all blocks before the first exchange
    }
    copies_end<0>();  // the next body uses the same memory
    __syncthreads();
}

#ifdef STAGES
// Whether a body takes part in the attempt. One at rest has nothing to solve, except by backward Euler.
__device__ __forceinline__ bool takes_part(const PcgArguments& s, const StageSolve& stage, const RowRange& range) {
    const int k = range.body;
    if (stage.phase[k] == OPEN && stage.state[k].form == stage.form && (s.moving[k] || stage.form == EULER)) return true;
    if (stage.first_of_step && range.index == 0 && threadIdx.x == 0)
        s.results[(s.step[0] % s.capacity) * s.count + k] = no_solve(s.bodies[k]);
    return false;
}
#endif

extern "C" __global__ void __launch_bounds__(THREADS, PER_PROCESSOR) pcg(const PcgArguments s KIND_OF_STEP CORRECTION HELP) {
#ifdef NEWTON_PHASES
    if (*active == 0) return;
#endif
    for (int next = s.initial_range[blockIdx.x];; next = -1) {
        if (next < 0) {  // take the next body of the pool
            if (threadIdx.x == 0) memory.next = s.pooled > 0 ? atomicAdd(s.pool_counter, 1) : s.pooled;
            __syncthreads();
#ifdef ALONE
            if (memory.next == s.pooled && s.pooled > 0) sort_pool(s);
            if (memory.next >= s.pooled) return;
            next = s.bodies[pool_order(s, s.step[0])[memory.next]].first_range;
#else
            if (memory.next >= s.pooled) return;
            next = s.bodies[s.order[s.count - s.pooled + memory.next]].first_range;
#endif
        }
#ifdef NEWTON_PHASES
        const bool solved = phase[s.row_ranges[next].body] != 0;
#elif defined(STAGES)
        const bool solved = !takes_part(s, stage, s.row_ranges[next]);
#elif defined(CONTACT_PASSES)
        const int contact_phase = pass.state[s.row_ranges[next].body].phase;
        const bool solved = pass.first_of_step ? contact_phase == OVER : contact_phase != READY;
#else
        const bool solved = false;
#endif
        if (solved) {
            __syncthreads();  // all threads have read memory.next
            continue;
        }
        solve_body(s, s.row_ranges[next] STAGE CORRECTED_BY HELPED_BY);
    }
}
