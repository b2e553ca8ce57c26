// SPDX-License-Identifier: MIT
// Negative eigenvalues of symmetric 9x9 matrices and their eigenvectors: Householder's reflections to a tridiagonal matrix, then QL
// with implicit shifts (Bowdler, Martin, Reinsch, Wilkinson 1968) until as many are found as Sturm's sequence counts. Items of a
// vector go through the same rotations; where one of them has nothing to turn, it turns by nothing.
#pragma once
#include "polar.cuh"

// value[k] is an eigenvalue and vector[k] its vector where it is negative; the others span the rest.
template <class T> struct Eigen9 { T value[9], vector[9][9]; };

// a, its entries about 1 -> diagonal d and subdiagonal e of Q^T a Q; the rows of q are the columns of Q. a is used up.
template <class T> INLINE void tridiagonal9(T (&a)[9][9], T (&d)[9], T (&e)[9], T (&q)[9][9]) {
    const T least = T{} + (single<T> ? (entry<T>)1e-30 : (entry<T>)1e-250);
    T beta[7], w[9];
    for (int k = 0; k < 7; ++k) {  // 1 - beta v v^T takes column k below the subdiagonal away; v stays in its place
        T tail = T{}, x = a[k + 1][k];
        for (int i = k + 2; i < 9; ++i) tail += a[i][k] * a[i][k];
        T root = sqrt(x * x + tail), other = x < 0 ? root : -root, size = other * (other - x);
        beta[k] = size > least ? 1 / size : T{};
        d[k] = a[k][k];
        e[k] = other;
        a[k + 1][k] = x - other;
        T along = T{};
        for (int i = k + 1; i < 9; ++i) {
            T sum = T{};
            for (int j = k + 1; j < 9; ++j) sum += a[i][j] * a[j][k];
            w[i] = beta[k] * sum;
            along += w[i] * a[i][k];
        }
        along *= (entry<T>)0.5 * beta[k];
        for (int i = k + 1; i < 9; ++i) w[i] -= along * a[i][k];
        for (int i = k + 1; i < 9; ++i)
            for (int j = k + 1; j < 9; ++j) a[i][j] -= a[i][k] * w[j] + w[i] * a[j][k];
    }
    d[7] = a[7][7]; d[8] = a[8][8];
    e[7] = a[8][7]; e[8] = T{};
    for (int r = 0; r < 9; ++r)
        for (int c = 0; c < 9; ++c) q[r][c] = T{} + (entry<T>)(r == c);
    for (int k = 6; k >= 0; --k) {
        for (int c = k + 1; c < 9; ++c) {
            T sum = T{};
            for (int r = k + 1; r < 9; ++r) sum += a[r][k] * q[c][r];
            sum *= beta[k];
            for (int r = k + 1; r < 9; ++r) q[c][r] -= sum * a[r][k];
        }
    }
}

// One sweep of QL from row m, of each item its own, up to row l; where not active nothing.
template <class T, class M> INLINE void ql_sweep(T (&d)[9], T (&e)[9], T (&q)[9][9], int l, T m, T d_m, M active) {
    const T tiny = T{} + (single<T> ? (entry<T>)1e-37 : (entry<T>)1e-300);
    T half = (entry<T>)0.5 * (d[l + 1] - d[l]), root = sqrt(half * half + e[l] * e[l]) + tiny;
    T g = d_m - d[l] + e[l] * e[l] / (half < 0 ? half - root : half + root), s = T{} + 1, c = s, p = T{};
    for (int i = 7; i >= l; --i) {
        auto here = active && m > (entry<T>)i;
        T f = s * e[i], b = c * e[i], r = sqrt(f * f + g * g), inverse = 1 / (r + tiny);
        auto turns = here && r > 0;
        e[i + 1] = here ? r : e[i + 1];
        s = turns ? f * inverse : here ? T{} : s;
        c = turns ? g * inverse : here ? T{} + 1 : c;
        T before = d[i + 1] - p, t = (d[i] - before) * s + 2 * c * b;
        p = here ? s * t : p;
        d[i + 1] = here ? before + p : d[i + 1];
        g = here ? c * t - b : g;
        T turn = here ? s : T{}, stay = here ? c : T{} + 1;
        for (int k = 0; k < 9; ++k) {
            T x = q[i][k], y = q[i + 1][k];
            q[i + 1][k] = turn * x + stay * y;
            q[i][k] = stay * x - turn * y;
        }
    }
    d[l] = active ? d[l] - p : d[l];
    e[l] = active ? g : e[l];
    for (int k = 0; k < 9; ++k) e[k] = active && m == (entry<T>)k ? T{} : e[k];
}

// How many eigenvalues are below -shift: negative pivots of L D L^T.
template <class T> INLINE T below(const T (&d)[9], const T (&e)[9], T shift) {
    const T tiny = T{} + (single<T> ? (entry<T>)1e-37 : (entry<T>)1e-300);
    T count = T{}, pivot = T{} + 1;
    for (int k = 0; k < 9; ++k) {
        pivot = d[k] + shift - (k > 0 ? e[k - 1] * e[k - 1] / pivot : T{});
        pivot = magnitude(pivot) > tiny ? pivot : tiny;
        count += pivot < 0 ? T{} + 1 : T{};
    }
    return count;
}

// a is used up.
template <class T> INLINE void eigen9(T (&a)[9][9], Eigen9<T>& out) {
    T (&d)[9] = out.value, e[9], scale = T{} + (single<T> ? (entry<T>)1e-37 : (entry<T>)1e-300);
    for (int r = 0; r < 9; ++r)
        for (int c = 0; c <= r; ++c) scale += magnitude(a[r][c]);
    const T inverse = 1 / scale;
    for (int r = 0; r < 9; ++r)
        for (int c = 0; c < 9; ++c) a[r][c] *= inverse;  // what follows has squares
    tridiagonal9(a, d, e, out.vector);
    T size = T{};
    for (int k = 0; k < 9; ++k) size += magnitude(d[k]) + magnitude(e[k]);
    const T little = (single<T> ? (entry<T>)5e-8 : (entry<T>)1e-16) * size;
    const T none = 8 * little;  // rounding's: those nearer to zero need not be found, nor do they count as found
    T left = below(d, e, none);
    for (int l = 0; l < 8 && any(left > 0); ++l) {
        for (int sweep = 0; sweep < 30; ++sweep) {
            T m = T{} + 8, d_m = d[8];  // first row from l on with nothing below it
            for (int k = 7; k >= l; --k) {
                auto free = !(magnitude(e[k]) > little);
                m = free ? T{} + (entry<T>)k : m;
                d_m = free ? d[k] : d_m;
            }
            auto active = left > 0 && m > (entry<T>)l;
            if (!any(active)) break;
            ql_sweep(d, e, out.vector, l, m, d_m, active);
        }
        left -= d[l] < -2 * none ? T{} + 1 : T{};
    }
    for (int k = 0; k < 9; ++k) d[k] *= scale;
}
