// SPDX-License-Identifier: MIT
// What one application of a factor says about it, beside one of block Jacobi.
//
// Factors of one pattern are applied TOGETHER at a time. In a triangle of L each number waits for the one before, which takes most of
// the time of a small factor; those of others are worked on meanwhile. Each gets the same bits as if it were alone.
#pragma once
#include "pcg.h"

namespace {

enum Part { WITH_FACTOR = 1, WITH_BLOCK_JACOBI = 2 };

constexpr int TOGETHER = 4;

// True if they are of one pattern, type and probe vector, so that they may be applied together.
bool alike(const Factor& a, const Factor& b) {
    const Pattern &p = *a.pattern, &q = *b.pattern;
    return a.bytes == b.bytes && !p.plan && !q.plan && p.size == q.size && p.supernodes == q.supernodes &&
           p.permutation == q.permutation && p.super_start == q.super_start && p.row_start == q.row_start && p.rows == q.rows &&
           p.value_start == q.value_start;
}

// s - a b, with one rounding where the processor can: else a compiler that works on one factor at a time would choose otherwise than
// one that works on several.
template <class T>
T minus_product(T s, T a, T b) {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
    return std::fma(-a, b, s);
#else
    return s - a * b;
#endif
}

// What one supernode does to other rows and what these do to it, but for its triangle. Not inlined, so that it has the same bits
// wherever it is called: compilers choose which of two products they round.
template <class T>
__attribute__((noinline)) void forward(const Panel<T>& L, T* x, const int32_t* rows, T* y, T* scratch) {
    if (L.columns == 3) forward_node(L, x, rows, y);
    else forward_below(L, x, rows, y, scratch);
}

template <class T>
__attribute__((noinline)) void backward(const Panel<T>& L, T* x, const int32_t* rows, const T* y, T* scratch) {
    if (L.columns == 3) backward_node(L, x, rows, y);
    else backward_below(L, x, rows, y, scratch);
}

// As apply_factor (supernodal.h), of several factors. work: (COUNT + 1) size entries
template <class T, int COUNT>
void apply_together(const Factor* factors, const double* r, double scale, double* const* z, T* work) {
    const Pattern& p = *factors[0].pattern;
    T *y[COUNT], *scratch = work + (int64_t)COUNT * p.size;
    for (int f = 0; f < COUNT; ++f) {
        y[f] = work + (int64_t)f * p.size;
        for (int i = 0; i < p.size; ++i) y[f][i] = (T)(scale * r[p.permutation[i]]);
    }
    auto panels = [&](int s, auto with) {
        const int first = p.super_start[s], columns = p.super_start[s + 1] - first;
        const int height = (int)(p.row_start[s + 1] - p.row_start[s]);
        Panel<T> L[COUNT];
        T* x[COUNT];
        for (int f = 0; f < COUNT; ++f) {
            L[f] = {(const T*)factors[f].values + p.value_start[s], columns, height};
            x[f] = y[f] + first;
        }
        with(L, x, p.rows + p.row_start[s], columns);
    };
    for (int s = 0; s < p.supernodes; ++s)
        panels(s, [&](const Panel<T>* L, T* const* x, const int32_t* rows, int columns) {
            for (int k = 0; k < columns && columns != 3; ++k)
                for (int f = 0; f < COUNT; ++f) {
                    const T* c = L[f].column(k);
                    T *own = x[f], xk = own[k] / c[k];
                    own[k] = xk;
                    for (int r = k + 1; r < columns; ++r) own[r] = minus_product(own[r], c[r], xk);
                }
            for (int f = 0; f < COUNT; ++f) forward(L[f], x[f], rows, y[f], scratch);
        });
    for (int s = p.supernodes - 1; s >= 0; --s)
        panels(s, [&](const Panel<T>* L, T* const* x, const int32_t* rows, int columns) {
            for (int f = 0; f < COUNT; ++f) backward(L[f], x[f], rows, y[f], scratch);
            for (int k = columns - 1; k >= 0 && columns != 3; --k) {
                const T* c[COUNT];
                T sum[COUNT];
                for (int f = 0; f < COUNT; ++f) c[f] = L[f].column(k), sum[f] = x[f][k];
                for (int r = k + 1; r < columns; ++r)
                    for (int f = 0; f < COUNT; ++f) sum[f] = minus_product(sum[f], c[f][r], x[f][r]);
                for (int f = 0; f < COUNT; ++f) x[f][k] = sum[f] / c[f][k];
            }
        });
    const double back = 1 / scale;
    for (int f = 0; f < COUNT; ++f)
        for (int i = 0; i < p.size; ++i) z[f][p.permutation[i]] = back * (double)y[f][i];
}

struct Body {
    BlockCsr A;  // nodes numbered from 0; values null: unknown
    const double* r;
};

// z and z.r of some factors that are alike. work: (COUNT + 1) n entries
template <int COUNT>
void apply(const Body* bodies, const Factor* factors, double* const* z, double* work, double* out) {
    const double* r = bodies[0].r;
    const int n = bodies[0].A.size();
    const double scale = 1 / std::sqrt(dot(n, r, r));
    if (factors[0].bytes == 4) apply_together<float, COUNT>(factors, r, scale, z, (float*)work);
    else apply_together<double, COUNT>(factors, r, scale, z, work);
    for (int f = 0; f < COUNT; ++f) out[5 * f] = dot(bodies[f].A, z[f], r);
}

// out of wf_judge_all of one body with values of A. z: P^-1 r. work: 5 n entries
__attribute__((noinline)) void judge(int parts, const Body& body, const double* z, double* work, double* out) {
    const BlockCsr& A = body.A;
    const double* r = body.r;
    const int n = A.size();
    double *q = work, *jacobi = q + n, *inverse = jacobi + n;
    if (parts & WITH_FACTOR) {
        out[1] = multiply(A, z, q);
        double left = 0;
        for (int i = 0; i < n; ++i) left += (r[i] - q[i]) * (r[i] - q[i]);
        out[4] = std::sqrt(left / dot(n, r, r));
    }
    if (!(parts & WITH_BLOCK_JACOBI)) return;
    invert_diagonal(A, true, inverse);
    out[2] = apply_diagonal(A, inverse, r, jacobi);
    out[3] = multiply(A, jacobi, q);
}

// Factors to be judged: as of wf_judge_all.
struct Given {
    int32_t count, parts;
    const Factor* factors;
    const int32_t *nodes, *const *row_start, *const *columns;
    const double *const *values, *const *r, *const *applied;
    double* out;

    // How many factors from the i-th on are applied together.
    int together(int i) const {
        bool all = i + TOGETHER <= count;
        for (int f = 1; f < TOGETHER && all; ++f)
            all = alike(factors[i], factors[i + f]) && r[i] == r[i + f] && !applied[i] && !applied[i + f];
        return all ? TOGETHER : 1;
    }

    // Judges `some` factors from the i-th on.
    void judge_some(int i, int some, double* work) const {
        Body body[TOGETHER];
        const double* z[TOGETHER];
        double* made[TOGETHER];
        const int64_t n = 3 * (int64_t)nodes[i];
        for (int f = 0; f < some; ++f) {
            body[f] = {{0, nodes[i + f], row_start[i + f], columns[i + f], values[i + f]}, r[i + f]};
            z[f] = made[f] = work + f * n;
        }
        double *room = work + TOGETHER * n, *own = out + 5 * i;
        if (parts & WITH_FACTOR) {
            if (applied[i]) own[0] = dot(body[0].A, z[0] = applied[i], r[i]);
            else if (some == TOGETHER) apply<TOGETHER>(body, factors + i, made, room, own);
            else apply<1>(body, factors + i, made, room, own);
        }
        for (int f = 0; f < some; ++f)
            if (values[i + f]) judge(parts, body[f], z[f], room, own + 5 * f);
    }
};

}  // namespace
