// SPDX-License-Identifier: MIT
// z = P^T L^-T L^-1 P r on a team of threads (factor_plan.h says who does what). Nobody waits for all others: a panel is solved once what
// its children add to it is there, and its chunks wait for the panel alone, so that one half of the tree goes on while the other one
// is late. Flags count sweeps, so that nothing has to be set back.
#pragma once
#include <cstring>

#include "factor_plan.h"
#include "team.h"

template <class T> struct Sweeps {
    FactorPlan& plan;
    const T* values;
    const double *r, scale;
    double* z;
    T *y = (T*)plan.room.get(), *part = (T*)plan.partial.get();

    Panel<T> supernode(int s) const { return {values + plan.p.value_start[s], plan.width(s), plan.height(s)}; }

    // --- towards the root -----------------------------------------------------------------------------------------------------------

    void gather(int first, int last) const {
        for (int i = first; i < last; ++i) y[i] = (T)(scale * r[plan.p.permutation[i]]);
    }

    void forward_task(const FactorPlan::Task& t, T* scratch) const {
        const Pattern& p = plan.p;
        gather(p.super_start[t.first], p.super_start[t.last]);
        if (t.parent >= 0) std::fill(y + t.sums, y + t.sums + t.size, (T)0);
        for (int s = t.first; s < t.last; ++s)
            forward_panel(supernode(s), y + p.super_start[s], plan.target.data() + p.row_start[s], y, scratch);
        if (t.parent >= 0) plan.arrived[t.parent].count.fetch_add(1, std::memory_order_release);
    }

    // Adds what the children of a panel have for its rows [first, last) to `to`.
    void add_children(const FactorPlan::Panel& b, int first, int last, T* to) const {
        for (int k = 0; k < b.children; ++k) {
            const T* from = y + plan.child[b.first_child + k] + first;
#pragma omp simd
            for (int i = 0; i < last - first; ++i) to[i] += from[i];
        }
    }

    void forward_solve(int index) const {
        const FactorPlan::Panel& b = plan.panel[index];
        const std::atomic<uint64_t>& arrived = plan.arrived[index].count;
        const uint64_t wanted = b.arrivals * plan.sweeps;
        wait_for([&] { return arrived.load(std::memory_order_acquire) >= wanted; });
        const int at = plan.p.super_start[b.supernode] + b.from;
        T* x = y + at;
        gather(at, at + b.columns);
        add_children(b, 0, b.columns, x);
        const Panel<T> L = supernode(b.supernode);
        for (int k = 0; k < b.columns; ++k) {
            const T *c = L.column(b.from + k) + b.from, xk = x[k] / c[k];
            x[k] = xk;
#pragma omp simd
            for (int i = k + 1; i < b.columns; ++i) x[i] -= c[i] * xk;
        }
        plan.solved[index].count.store(plan.sweeps, std::memory_order_release);
    }

    // Chunks [begin, end) of one panel. Whole columns are read one after another, as they lie in memory; each row has its terms subtracted
    // in the order of the columns, whatever chunks come together.
    void forward_chunks(int begin, int end, T* __restrict sum) const {
        const FactorPlan::Panel& b = plan.panel[plan.chunk[begin].panel];
        const std::atomic<uint64_t>& solved = plan.solved[plan.chunk[begin].panel].count;
        wait_for([&] { return solved.load(std::memory_order_acquire) >= plan.sweeps; });
        const int first = plan.chunk[begin].first, count = plan.chunk[end - 1].last - first;
        const T* x = y + plan.p.super_start[b.supernode] + b.from;
        const Panel<T> L = supernode(b.supernode);
        for (int i = 0; i < count; ++i) sum[i] = 0;
        add_children(b, first - b.from, first - b.from + count, sum);
        int k = 0;
        for (; k + 4 <= b.columns; k += 4) {
            const T *a0 = L.column(b.from + k) + first, *a1 = L.column(b.from + k + 1) + first;
            const T *a2 = L.column(b.from + k + 2) + first, *a3 = L.column(b.from + k + 3) + first;
            const T x0 = x[k], x1 = x[k + 1], x2 = x[k + 2], x3 = x[k + 3];
#pragma omp simd
            for (int i = 0; i < count; ++i) sum[i] = (((sum[i] - a0[i] * x0) - a1[i] * x1) - a2[i] * x2) - a3[i] * x3;
        }
        for (; k < b.columns; ++k) {
            const T *a = L.column(b.from + k) + first, xk = x[k];
#pragma omp simd
            for (int i = 0; i < count; ++i) sum[i] = sum[i] - a[i] * xk;
        }
        if (b.inside) {
            std::copy(sum, sum + count, y + b.sums + (first - b.from - b.columns));
        } else {
            const int32_t* to = plan.target.data() + plan.p.row_start[b.supernode] + first;
            for (int i = 0; i < count; ++i) y[to[i]] = sum[i];
        }
        if (b.parent >= 0) plan.arrived[b.parent].count.fetch_add(end - begin, std::memory_order_release);
    }

    // --- back from the root ---------------------------------------------------------------------------------------------------------

    // z of degrees of freedom [first, last) of the order of L; returns their part of z . r
    double scatter(int first, int last) const {
        const double back = 1 / scale;
        double sum = 0;
        for (int i = first; i < last; ++i) {
            const int k = plan.p.permutation[i];
            const double value = back * (double)y[i];
            z[k] = value;
            sum += value * r[k];
        }
        return sum;
    }

    void wait_for_parent(int parent) const {
        if (parent < 0) return;
        const std::atomic<uint64_t>& known = plan.known[parent].count;
        wait_for([&] { return known.load(std::memory_order_acquire) >= plan.sweeps; });
    }

    // Chunks [begin, end) of one panel: for each of its columns the product of each chunk.
    void backward_chunks(int begin, int end, T* __restrict below) const {
        const FactorPlan::Panel& b = plan.panel[plan.chunk[begin].panel];
        wait_for_parent(b.parent);
        const int first = plan.chunk[begin].first, count = plan.chunk[end - 1].last - first;
        const int32_t* rows = plan.p.rows + plan.p.row_start[b.supernode] + first;
        for (int i = 0; i < count; ++i) below[i] = y[rows[i]];
        const Panel<T> L = supernode(b.supernode);
        int k = 0;
        for (; k + 4 <= b.columns; k += 4) {
            const T *a0 = L.column(b.from + k) + first, *a1 = L.column(b.from + k + 1) + first;
            const T *a2 = L.column(b.from + k + 2) + first, *a3 = L.column(b.from + k + 3) + first;
            for (int c = begin; c < end; ++c) {
                T s0 = 0, s1 = 0, s2 = 0, s3 = 0;
#pragma omp simd reduction(+ : s0, s1, s2, s3)
                for (int i = plan.chunk[c].first - first; i < plan.chunk[c].last - first; ++i) {
                    const T w = below[i];
                    s0 += a0[i] * w; s1 += a1[i] * w; s2 += a2[i] * w; s3 += a3[i] * w;
                }
                T* out = part + (int64_t)c * PANEL + k;
                out[0] = s0; out[1] = s1; out[2] = s2; out[3] = s3;
            }
        }
        for (; k < b.columns; ++k) {
            const T* a = L.column(b.from + k) + first;
            for (int c = begin; c < end; ++c) {
                T s = 0;
#pragma omp simd reduction(+ : s)
                for (int i = plan.chunk[c].first - first; i < plan.chunk[c].last - first; ++i) s += a[i] * below[i];
                part[(int64_t)c * PANEL + k] = s;
            }
        }
        plan.returned[plan.chunk[begin].panel].count.fetch_add(end - begin, std::memory_order_release);
    }

    void backward_solve(int index) const {
        const FactorPlan::Panel& b = plan.panel[index];
        const std::atomic<uint64_t>& returned = plan.returned[index].count;
        const uint64_t wanted = b.chunks * plan.sweeps;
        wait_for([&] { return returned.load(std::memory_order_acquire) >= wanted; });
        const int at = plan.p.super_start[b.supernode] + b.from;
        T* x = y + at;
        for (int c = 0; c < b.chunks; ++c) {
            const T* from = part + (int64_t)(b.chunk + c) * PANEL;
#pragma omp simd
            for (int k = 0; k < b.columns; ++k) x[k] -= from[k];
        }
        const Panel<T> L = supernode(b.supernode);
        for (int k = b.columns - 1; k >= 0; --k) {
            const T* c = L.column(b.from + k) + b.from;
            T s = 0;
#pragma omp simd reduction(+ : s)
            for (int i = k + 1; i < b.columns; ++i) s += c[i] * x[i];
            x[k] = (x[k] - s) / c[k];
        }
        plan.known[index].count.store(plan.sweeps, std::memory_order_release);
        plan.product[plan.task.size() + index] = scatter(at, at + b.columns);
    }

    void backward_task(int index, T* scratch) const {
        const FactorPlan::Task& t = plan.task[index];
        const Pattern& p = plan.p;
        wait_for_parent(t.parent);
        for (int s = t.last; s-- > t.first;) backward_panel(supernode(s), y + p.super_start[s], p.rows + p.row_start[s], y, scratch);
        plan.product[index] = scatter(p.super_start[t.first], p.super_start[t.last]);
    }

    // --- all of it ------------------------------------------------------------------------------------------------------------------

    // What thread k of `parts` does is what threads k, k + parts, ... of the plan are to do. What a panel needs is done before it on
    // every thread, so nobody waits for what comes later on its own.
    void forward(int k, int parts) const {
        T* scratch = y + plan.scratch + k * plan.own_room();
        for (int t = k; t < plan.threads; t += parts)
            for (int i = plan.task_of[t]; i < plan.task_of[t + 1]; ++i) forward_task(plan.task[i], scratch);
        for (int level = plan.levels; level-- > 0;) {
            each_of_level(level, k, parts, plan.solve_of, [&](int i) { forward_solve(plan.solve[i]); });
            each_share(level, k, parts, [&](int begin, int end) { forward_chunks(begin, end, scratch); });
        }
    }
    void backward(int k, int parts) const {
        T* scratch = y + plan.scratch + k * plan.own_room();
        for (int level = 0; level < plan.levels; ++level) {
            each_share(level, k, parts, [&](int begin, int end) { backward_chunks(begin, end, scratch); });
            each_of_level(level, k, parts, plan.solve_of, [&](int i) { backward_solve(plan.solve[i]); });
        }
        for (int t = k; t < plan.threads; t += parts)
            for (int i = plan.task_of[t]; i < plan.task_of[t + 1]; ++i) backward_task(i, scratch);
    }
    template <class F> void each_of_level(int level, int k, int parts, const std::vector<int>& of, F f) const {
        for (int t = k; t < plan.threads; t += parts)
            for (int i = of[level * plan.threads + t]; i < of[level * plan.threads + t + 1]; ++i) f(i);
    }
    // f(begin, end) of chunks of a panel that a thread of the plan has.
    template <class F> void each_share(int level, int k, int parts, F f) const {
        for (int t = k; t < plan.threads; t += parts) {
            const int last = plan.share_of[level * plan.threads + t + 1];
            for (int begin = plan.share_of[level * plan.threads + t], end; begin < last; begin = end) {
                for (end = begin + 1; end < last && plan.chunk[end].panel == plan.chunk[begin].panel;) ++end;
                f(begin, end);
            }
        }
    }
};

// z = P^-1 r; returns z . r. scale, between: as of apply_factor without a plan; whole: nothing is to be done between the sweeps.
template <class T, class F>
static double apply_factor(FactorPlan& plan, const T* values, const double* r, double scale, double* z, int threads, bool whole, F between) {
    if (plan.bytes != (int)sizeof(T)) {  // entries that are 0 for good were numbers of the other type
        std::memset(plan.room.get(), 0, sizeof(double) * plan.entries);
        plan.bytes = sizeof(T);
    }
    ++plan.sweeps;
    const Sweeps<T> sweeps{plan, values, r, scale, z};
    threads = std::min(threads, plan.threads);
    if (whole) {
        Team::run(threads, [&](int k, int parts) {
            sweeps.forward(k, parts);
            sweeps.backward(k, parts);
        });
    } else {
        Team::run(threads, [&](int k, int parts) { sweeps.forward(k, parts); });
        between(sweeps.y);
        Team::run(threads, [&](int k, int parts) { sweeps.backward(k, parts); });
    }
    double sum = 0;
    for (size_t i = 0; i < plan.task.size() + plan.panel.size(); ++i) sum += plan.product[i];
    return sum;
}
