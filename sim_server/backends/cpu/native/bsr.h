// SPDX-License-Identifier: MIT
// Block sparse rows of 3x3 blocks (BSR), and the vector loops of conjugate gradients, fused so that each vector is read once.
#pragma once
#include <cmath>
#include <cstdint>

#include "contact_rows.h"
#include "invert3.cuh"
#include "rank_one.h"

struct BlockCsr {
    int32_t first, last;        // nodes [first, last) of a body; vectors below start at its first node
    const int32_t* row_start;   // (nodes + 1,) of the scene, into columns and values
    const int32_t* columns;     // node numbers in the scene
    const double* values;       // (blocks, 3, 3)
    const Rows* rows = nullptr;  // of contacts that A has beside its values, or null
    const RankOne* rank_one = nullptr;  // parts of rank one that it has, too, or null
    int body = 0;               // whose they are
    int size() const { return 3 * (last - first); }
};

// y = A x; returns x . y
static double multiply(const BlockCsr& A, const double* x, double* y) {
    double sum = 0;
    for (int i = A.first; i < A.last; ++i) {
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
    if (A.rank_one) sum += add_product(*A.rank_one, A.body, A.first, x, y);
    return A.rows ? sum + A.rows->add_product(x, y) : sum;
}

static double dot(int n, const double* a, const double* b) {
    double s = 0;
#pragma omp simd reduction(+ : s)
    for (int i = 0; i < n; ++i) s += a[i] * b[i];
    return s;
}

// r = b - A x; returns |r|^2
static double residual(const BlockCsr& A, const double* b, const double* x, double* r) {
    multiply(A, x, r);
    double s = 0;
    int n = A.size();
#pragma omp simd reduction(+ : s)
    for (int i = 0; i < n; ++i) {
        double d = b[i] - r[i];
        r[i] = d;
        s += d * d;
    }
    return s;
}

// x += alpha p, r -= alpha q; returns |r|^2
static double descend(int n, double alpha, const double* p, const double* q, double* x, double* r) {
    double s = 0;
#pragma omp simd reduction(+ : s)
    for (int i = 0; i < n; ++i) {
        x[i] += alpha * p[i];
        double d = r[i] - alpha * q[i];
        r[i] = d;
        s += d * d;
    }
    return s;
}

// p = z + beta p
static void conjugate(int n, double beta, const double* z, double* p) {
#pragma omp simd
    for (int i = 0; i < n; ++i) p[i] = z[i] + beta * p[i];
}

// Inverses of the diagonal blocks (whole = true) or of the diagonal entries.
static void invert_diagonal(const BlockCsr& A, bool whole, double* inverse) {
    for (int i = A.first; i < A.last; ++i) {
        int k = A.row_start[i];
        while (A.columns[k] != i) ++k;
        double* block = inverse + 9 * (int64_t)(i - A.first);
        for (int m = 0; m < 9; ++m) block[m] = A.values[9 * (int64_t)k + m];
    }
    if (A.rows) A.rows->add_diagonal(inverse, A.last);
    for (int i = 0; i < A.last - A.first; ++i) {
        double block[9];
        for (int m = 0; m < 9; ++m) block[m] = inverse[9 * (int64_t)i + m];
        invert3(block, whole, inverse + 9 * (int64_t)i);
    }
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

static void apply_diagonal(int nodes, const double* inverse, const double* r, double* z) {
#pragma omp simd
    for (int i = 0; i < nodes; ++i) {
        const double *v = inverse + 9 * i, *s = r + 3 * i;
        double* t = z + 3 * i;
        t[0] = v[0] * s[0] + v[1] * s[1] + v[2] * s[2];
        t[1] = v[3] * s[0] + v[4] * s[1] + v[5] * s[2];
        t[2] = v[6] * s[0] + v[7] * s[1] + v[8] * s[2];
    }
}
