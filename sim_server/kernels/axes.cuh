// SPDX-License-Identifier: MIT
// Eigenvalues and eigenvectors of a symmetric 3x3 matrix, by Jacobi's rotations: to rounding whatever the eigenvalues, equal
// ones included. A fixed number of sweeps, without branches: each squares what is left off the diagonal or better.
#pragma once
#include "mat3.cuh"

template <class T> struct Axes {
    T value[3];
    vec<T> axis[3];  // orthonormal
};

// One rotation, in the plane of axes p and q, that makes the entry pq zero; r is the third.
template <class T> INLINE void level(T& pp, T& qq, T& pq, T& pr, T& qr, vec<T>& p, vec<T>& q) {
    const T none = T{} + (entry<T>)1e-30;
    T d = qq - pp, root = sqrt(d * d + 4 * pq * pq) + none;
    T t = (d < 0 ? -2 * pq : 2 * pq) / ((d < 0 ? -d : d) + root);
    T c = 1 / sqrt(1 + t * t), s = t * c, u = pr;
    pp -= t * pq;
    qq += t * pq;
    pq = T{};
    pr = c * u - s * qr;
    qr = s * u + c * qr;
    vec<T> a = p;
    p = c * a - s * q;
    q = s * a + c * q;
}

template <class T> INLINE Axes<T> axes_of(T xx, T xy, T xz, T yy, T yz, T zz) {
    const T one = T{} + 1;
    Axes<T> a = {{xx, yy, zz}, {{one, T{}, T{}}, {T{}, one, T{}}, {T{}, T{}, one}}};
    for (int sweep = 0; sweep < (sizeof(entry<T>) == 4 ? 4 : 5); ++sweep) {
        level(a.value[0], a.value[1], xy, xz, yz, a.axis[0], a.axis[1]);
        level(a.value[0], a.value[2], xz, xy, yz, a.axis[0], a.axis[2]);
        level(a.value[1], a.value[2], yz, xy, xz, a.axis[1], a.axis[2]);
    }
    return a;
}
