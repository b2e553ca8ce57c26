// SPDX-License-Identifier: MIT
// z = P^T L^-T L^-1 P r for a Cholesky factor in supernodal form (format: protocol/factor.py).
//
// Column k of a supernode with nr rows starts at its diagonal; the columns lie one after another. Four columns at a time, so
// that a row's sum is read and written once for four multiplications; L itself, which is most of the bytes, is read once.
#pragma once
#include <cstdint>

struct FactorPlan;

struct Pattern {
    int32_t size;                // degrees of freedom
    int32_t supernodes;
    const int32_t* permutation;  // (size,)
    const int32_t* super_start;  // (supernodes + 1,)
    const int64_t* row_start;    // (supernodes + 1,) into rows
    const int32_t* rows;
    const int64_t* value_start;  // (supernodes,) into the values
    FactorPlan* plan;            // how threads share the solves (factor_plan.h); null: one does all
};

// Number of values of L.
static double entries_of(const Pattern& p) {
    const int last = p.supernodes - 1;
    const double w = p.super_start[last + 1] - p.super_start[last], h = (double)(p.row_start[last + 1] - p.row_start[last]);
    return (double)p.value_start[last] + w * h - w * (w - 1) / 2;
}

template <class T>
struct Panel {
    const T* values;
    int columns, height;
    // entry (r, k), r >= k
    const T* column(int k) const { return values + (int64_t)k * height - (int64_t)k * (k + 1) / 2; }
};

// A panel of one node: all there is in incomplete factors. Its few rows are gathered and scattered where they are used.
template <class T>
static void forward_node(const Panel<T>& L, T* x, const int32_t* rows, T* y) {
    const T *a = L.column(0), *b = L.column(1), *c = L.column(2);
    const T x0 = x[0] / a[0], x1 = (x[1] - a[1] * x0) / b[1], x2 = (x[2] - a[2] * x0 - b[2] * x1) / c[2];
    x[0] = x0; x[1] = x1; x[2] = x2;
    for (int r = 3; r < L.height; ++r) y[rows[r]] -= a[r] * x0 + b[r] * x1 + c[r] * x2;
}

template <class T>
static void backward_node(const Panel<T>& L, T* x, const int32_t* rows, const T* y) {
    const T *a = L.column(0), *b = L.column(1), *c = L.column(2);
    T s0 = 0, s1 = 0, s2 = 0;
    for (int r = 3; r < L.height; ++r) {
        const T w = y[rows[r]];
        s0 += a[r] * w; s1 += b[r] * w; s2 += c[r] * w;
    }
    const T x2 = (x[2] - s2) / c[2], x1 = (x[1] - s1 - b[2] * x2) / b[1];
    x[0] = (x[0] - s0 - a[1] * x1 - a[2] * x2) / a[0];
    x[1] = x1; x[2] = x2;
}

// y -= L_below x for the rows under the triangle; `sum` is scratch
template <class T>
static void forward_below(const Panel<T>& L, const T* x, const int32_t* rows, T* y, T* sum) {
    int n = L.columns, h = L.height;
    if (h == n) return;
    int k = 0;
    for (int r = n; r < h; ++r) sum[r] = 0;
    for (; k + 4 <= n; k += 4) {
        const T *a = L.column(k), *b = L.column(k + 1), *c = L.column(k + 2), *d = L.column(k + 3);
        T xa = x[k], xb = x[k + 1], xc = x[k + 2], xd = x[k + 3];
#pragma omp simd
        for (int r = n; r < h; ++r) sum[r] += a[r] * xa + b[r] * xb + c[r] * xc + d[r] * xd;
    }
    for (; k < n; ++k) {
        const T* a = L.column(k);
        T xa = x[k];
#pragma omp simd
        for (int r = n; r < h; ++r) sum[r] += a[r] * xa;
    }
    for (int r = n; r < h; ++r) y[rows[r]] -= sum[r];
}

template <class T>
static void forward_panel(const Panel<T>& L, T* x, const int32_t* rows, T* y, T* sum) {
    if (L.columns == 3) return forward_node(L, x, rows, y);
    for (int k = 0; k < L.columns; ++k) {
        const T* c = L.column(k);
        T xk = x[k] / c[k];
        x[k] = xk;
        for (int r = k + 1; r < L.columns; ++r) x[r] -= c[r] * xk;
    }
    forward_below(L, x, rows, y, sum);
}

// x -= L_below^T y_below
template <class T>
static void backward_below(const Panel<T>& L, T* x, const int32_t* rows, const T* y, T* below) {
    int n = L.columns, h = L.height;
    for (int r = n; r < h; ++r) below[r] = y[rows[r]];
    int k = 0;
    for (; k + 4 <= n; k += 4) {
        const T *a = L.column(k), *b = L.column(k + 1), *c = L.column(k + 2), *d = L.column(k + 3);
        T sa = 0, sb = 0, sc = 0, sd = 0;
#pragma omp simd reduction(+ : sa, sb, sc, sd)
        for (int r = n; r < h; ++r) {
            T w = below[r];
            sa += a[r] * w; sb += b[r] * w; sc += c[r] * w; sd += d[r] * w;
        }
        x[k] -= sa; x[k + 1] -= sb; x[k + 2] -= sc; x[k + 3] -= sd;
    }
    for (; k < n; ++k) {
        const T* a = L.column(k);
        T sa = 0;
#pragma omp simd reduction(+ : sa)
        for (int r = n; r < h; ++r) sa += a[r] * below[r];
        x[k] -= sa;
    }
}

// x = L_triangle^-T (x - L_below^T y_below)
template <class T>
static void backward_panel(const Panel<T>& L, T* x, const int32_t* rows, const T* y, T* below) {
    if (L.columns == 3) return backward_node(L, x, rows, y);
    backward_below(L, x, rows, y, below);
    for (int k = L.columns - 1; k >= 0; --k) {
        const T* c = L.column(k);
        T s = x[k];
        for (int r = k + 1; r < L.columns; ++r) s -= c[r] * x[r];
        x[k] = s / c[k];
    }
}

// scale: 1 / |r|, so that a float factor neither overflows nor underflows. work: 2 size entries. between: what is done to
// L^-1 P r.
template <class T, class F>
static void apply_factor(const Pattern& p, const T* values, const double* r, double scale, double* z, T* work, F between) {
    T *y = work, *scratch = work + p.size;
    for (int i = 0; i < p.size; ++i) y[i] = (T)(scale * r[p.permutation[i]]);
    for (int s = 0; s < p.supernodes; ++s) {
        int64_t start = p.row_start[s];
        Panel<T> L{values + p.value_start[s], p.super_start[s + 1] - p.super_start[s], (int)(p.row_start[s + 1] - start)};
        forward_panel(L, y + p.super_start[s], p.rows + start, y, scratch);
    }
    between(y);
    for (int s = p.supernodes - 1; s >= 0; --s) {
        int64_t start = p.row_start[s];
        Panel<T> L{values + p.value_start[s], p.super_start[s + 1] - p.super_start[s], (int)(p.row_start[s + 1] - start)};
        backward_panel(L, y + p.super_start[s], p.rows + start, y, scratch);
    }
    double back = 1 / scale;
    for (int i = 0; i < p.size; ++i) z[p.permutation[i]] = back * (double)y[i];
}

template <class T>
static void apply_factor(const Pattern& p, const T* values, const double* r, double scale, double* z, T* work) {
    apply_factor(p, values, r, scale, z, work, [](T*) {});
}
