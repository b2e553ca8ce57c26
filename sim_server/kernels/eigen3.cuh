// SPDX-License-Identifier: MIT
// Eigenvalues and eigenvectors of symmetric 3x3 matrices.
#pragma once
#include "polar.cuh"

// One rotation of Jacobi's method for symmetric matrices, in the plane of p and q; r is the third.
template <class T, class M> INLINE void annul(T& pp, T& qq, T& pq, T& pr, T& qr, vec<T>& p, vec<T>& q, M settled) {
    const T tiny = T{} + (single<T> ? (entry<T>)1e-37 : (entry<T>)1e-300);
    T d = qq - pp, size = magnitude(d) + sqrt(d * d + 4 * pq * pq) + tiny;
    T t = (d < 0 ? -2 * pq : 2 * pq) / size;
    t = settled ? T{} : t;  // and its neighbours in a vector go on without it
    T c = 1 / sqrt(1 + t * t), s = t * c, x = pr;
    pp -= t * pq;
    qq += t * pq;
    pq = settled ? pq : T{};
    pr = c * x - s * qr;
    qr = s * x + c * qr;
    vec<T> u = p;
    p = c * u - s * q;
    q = s * u + c * q;
}

// Eigenvalues l and eigenvectors v (columns of a rotation or reflection, from those given) of the symmetric matrix with the
// entries 00, 01, 02, 11, 12, 22.
template <class T> INLINE void eigen3(T (&a)[6], vec<T> (&v)[3]) {
    const entry<T> eps = single<T> ? (entry<T>)1e-14 : (entry<T>)1e-32;
    for (int sweep = 0; sweep < 7; ++sweep) {
        T off = a[1] * a[1] + a[2] * a[2] + a[4] * a[4];
        T on = a[0] * a[0] + a[3] * a[3] + a[5] * a[5];
        auto settled = !(off > eps * on);
        if (!any(off > eps * on)) break;
        annul(a[0], a[3], a[1], a[2], a[4], v[0], v[1], settled);
        annul(a[0], a[5], a[2], a[1], a[4], v[0], v[2], settled);
        annul(a[3], a[5], a[4], a[1], a[2], v[1], v[2], settled);
    }
}
