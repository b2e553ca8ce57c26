// SPDX-License-Identifier: MIT
// Block sparse rows of 3x3 blocks (BSR), and the vector loops of conjugate gradients, fused so that each vector is read once.
//
// Loops over a body go through its nodes in runs of RUN, which threads share by the nonzeros of their rows. Sums are those of the runs,
// added in their order, whatever the number of threads.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "contact_rows.h"
#include "invert3.cuh"
#include "rank_one.h"
#include "team.h"

constexpr int RUN = 64;                // nodes
constexpr int NODES_OF_A_THREAD = 96;  // fewer are not worth a thread of their own

struct BlockCsr {
    int32_t first, last;        // nodes [first, last) of a body; vectors below start at its first node
    const int32_t* row_start;   // (nodes + 1,) of the scene, into columns and values
    const int32_t* columns;     // node numbers in the scene
    const double* values;       // (blocks, 3, 3)
    const Rows* rows = nullptr;  // of contacts that A has beside its values, or null
    const RankOne* rank_one = nullptr;  // parts of rank one that it has, too, or null
    int body = 0;               // whose they are
    int threads = 1;            // that may work on it
    int size() const { return 3 * (last - first); }
    int runs() const { return (last - first + RUN - 1) / RUN; }
    int parts() const { return std::max(1, std::min(threads, (last - first) / NODES_OF_A_THREAD)); }
    // First of the runs that part k of `parts` has.
    int run_of(int k, int parts) const {
        if (k <= 0) return 0;
        if (k >= parts) return runs();
        const int64_t before = row_start[first], share = (row_start[last] - before) * (int64_t)k / parts;
        int low = 0, high = runs();
        while (low < high) {
            const int middle = (low + high) / 2;
            if (row_start[first + middle * RUN] - before < share) low = middle + 1;
            else high = middle;
        }
        return low;
    }
};

// f(first, last) for runs of nodes of the body, counted from its first one; returns the sum of what it returns.
template <class F> static double sum_of_runs(const BlockCsr& A, F f) {
    const int nodes = A.last - A.first, runs = A.runs(), parts = A.parts();
    auto of = [&](int run) { return f(run * RUN, std::min(nodes, (run + 1) * RUN)); };
    double sum = 0;
    if (parts == 1 || Team::inside()) {
        for (int run = 0; run < runs; ++run) sum += of(run);
        return sum;
    }
    static thread_local std::vector<double> room;
    if ((int)room.size() < runs) room.resize(runs);
    double* const found = room.data();
    Team::run(parts, [&](int k, int parts) {
        for (int run = A.run_of(k, parts); run < A.run_of(k + 1, parts); ++run) found[run] = of(run);
    });
    for (int run = 0; run < runs; ++run) sum += found[run];
    return sum;
}
template <class F> static void each_run(const BlockCsr& A, F f) {
    const int nodes = A.last - A.first;
    Team::run(A.parts(), [&](int k, int parts) {
        const int first = A.run_of(k, parts) * RUN, last = std::min(nodes, A.run_of(k + 1, parts) * RUN);
        if (first < last) f(first, last);
    });
}

// y = A x for nodes [first, last) of the body; returns their x . y
static double multiply_rows(const BlockCsr& A, int first, int last, const double* x, double* y) {
    double sum = 0;
    for (int i = A.first + first; i < A.first + last; ++i) {
        double y0 = 0, y1 = 0, y2 = 0;
        for (int k = A.row_start[i]; k < A.row_start[i + 1]; ++k) {
            const double* a = A.values + 9 * (int64_t)k;
            const double* v = x + 3 * (A.columns[k] - A.first);
            y0 += a[0] * v[0] + a[1] * v[1] + a[2] * v[2];
            y1 += a[3] * v[0] + a[4] * v[1] + a[5] * v[2];
            y2 += a[6] * v[0] + a[7] * v[1] + a[8] * v[2];
        }
        double* w = y + 3 * (i - A.first);
        const double* u = x + 3 * (i - A.first);
        w[0] = y0; w[1] = y1; w[2] = y2;
        sum += u[0] * y0 + u[1] * y1 + u[2] * y2;
    }
    return sum;
}

// y = A x; returns x . y
static double multiply(const BlockCsr& A, const double* x, double* y) {
    double sum = sum_of_runs(A, [&](int first, int last) { return multiply_rows(A, first, last, x, y); });
    if (A.rank_one) sum += add_product(*A.rank_one, A.body, A.first, x, y);
    return A.rows ? sum + A.rows->add_product(x, y) : sum;
}

// Not inlined, so that the same vectors give the same bits wherever it is called.
__attribute__((noinline)) static double dot(int n, const double* a, const double* b) {
    double s = 0;
#pragma omp simd reduction(+ : s)
    for (int i = 0; i < n; ++i) s += a[i] * b[i];
    return s;
}

// The same of vectors of a body.
static double dot(const BlockCsr& A, const double* a, const double* b) {
    return sum_of_runs(A, [&](int first, int last) { return dot(3 * (last - first), a + 3 * first, b + 3 * first); });
}

// r = b - A x; returns |r|^2
static double residual(const BlockCsr& A, const double* b, const double* x, double* r) {
    multiply(A, x, r);
    return sum_of_runs(A, [&](int first, int last) {
#pragma omp simd
        for (int i = 3 * first; i < 3 * last; ++i) r[i] = b[i] - r[i];
        return dot(3 * (last - first), r + 3 * first, r + 3 * first);  // of |b| the same bits where x is 0
    });
}

// x += alpha p, r -= alpha q; returns |r|^2
static double descend(const BlockCsr& A, double alpha, const double* p, const double* q, double* x, double* r) {
    return sum_of_runs(A, [&](int first, int last) {
        double s = 0;
#pragma omp simd reduction(+ : s)
        for (int i = 3 * first; i < 3 * last; ++i) {
            x[i] += alpha * p[i];
            double d = r[i] - alpha * q[i];
            r[i] = d;
            s += d * d;
        }
        return s;
    });
}

// p = z + beta p
static void conjugate(const BlockCsr& A, double beta, const double* z, double* p) {
    each_run(A, [&](int first, int last) {
#pragma omp simd
        for (int i = 3 * first; i < 3 * last; ++i) p[i] = z[i] + beta * p[i];
    });
}

// Inverses of the diagonal blocks (whole = true) or of the diagonal entries.
static void invert_diagonal(const BlockCsr& A, bool whole, double* inverse) {
    each_run(A, [&](int first, int last) {
        for (int i = A.first + first; i < A.first + last; ++i) {
            int k = A.row_start[i];
            while (A.columns[k] != i) ++k;
            double* block = inverse + 9 * (int64_t)(i - A.first);
            for (int m = 0; m < 9; ++m) block[m] = A.values[9 * (int64_t)k + m];
        }
    });
    if (A.rows) A.rows->add_diagonal(inverse, A.last);
    each_run(A, [&](int first, int last) {
        for (int i = first; i < last; ++i) {
            double block[9];
            for (int m = 0; m < 9; ++m) block[m] = inverse[9 * (int64_t)i + m];
            invert3(block, whole, inverse + 9 * (int64_t)i);
        }
    });
}

static void multiply3(const double* a, const double* v, double* y) {
    for (int i = 0; i < 3; ++i) y[i] = a[3 * i] * v[0] + a[3 * i + 1] * v[1] + a[3 * i + 2] * v[2];
}

// y -= sum of A_ik x_k over places [k, end) of row i
static void subtract_row(const BlockCsr& A, int k, int end, const double* x, double y[3]) {
    for (; k < end; ++k) {
        const double *a = A.values + 9 * (int64_t)k, *v = x + 3 * (A.columns[k] - A.first);
        y[0] -= a[0] * v[0] + a[1] * v[1] + a[2] * v[2];
        y[1] -= a[3] * v[0] + a[4] * v[1] + a[5] * v[2];
        y[2] -= a[6] * v[0] + a[7] * v[1] + a[8] * v[2];
    }
}

// z = P^-1 r with P = (D/w + L) (D/w)^-1 (D/w + L^T) w / (2 - w), A = L + D + L^T in blocks: a sweep down, a sweep up.
// inverse: of the diagonal blocks.
static void apply_ssor(const BlockCsr& A, const double* inverse, double omega, const double* r, double* z) {
    const int n = A.last - A.first;
    for (int i = 0; i < n; ++i) {
        const int* row = A.row_start + A.first + i;
        int k = row[0];
        while (A.columns[k] != A.first + i) ++k;
        double t[3] = {0, 0, 0};
        subtract_row(A, row[0], k, z, t);
        for (int c = 0; c < 3; ++c) t[c] = (2 - omega) * r[3 * i + c] + omega * t[c];  // scaled here, not at the end
        multiply3(inverse + 9 * i, t, z + 3 * i);
    }
    for (int i = n - 1; i >= 0; --i) {
        const int* row = A.row_start + A.first + i;
        int k = row[1] - 1;
        while (A.columns[k] != A.first + i) --k;
        double t[3] = {0, 0, 0}, d[3];
        subtract_row(A, k + 1, row[1], z, t);
        multiply3(inverse + 9 * i, t, d);
        for (int c = 0; c < 3; ++c) z[3 * i + c] += omega * d[c];
    }
}

// z = the inverse blocks times r; returns z . r
static double apply_diagonal(const BlockCsr& A, const double* inverse, const double* r, double* z) {
    return sum_of_runs(A, [&](int first, int last) {
#pragma omp simd
        for (int i = first; i < last; ++i) {
            const double *v = inverse + 9 * i, *s = r + 3 * i;
            double* t = z + 3 * i;
            t[0] = v[0] * s[0] + v[1] * s[1] + v[2] * s[2];
            t[1] = v[3] * s[0] + v[4] * s[1] + v[5] * s[2];
            t[2] = v[6] * s[0] + v[7] * s[1] + v[8] * s[2];
        }
        return dot(3 * (last - first), z + 3 * first, r + 3 * first);
    });
}
