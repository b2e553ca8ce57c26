// SPDX-License-Identifier: MIT
// Isotropic laws by the invariants I1 = tr C, I2 = (tr^2 C - tr C^2) / 2 and J = det F (formulas: sim_server/effects/_hyperelastic.py).
#pragma once
#include "hyperelastic.cuh"

// The derivatives of W that a law has (HAS of its text): others cost nothing.
constexpr unsigned W_1 = 1, W_2 = 2, W_J = 4, W_11 = 8, W_12 = 16, W_22 = 32, W_1J = 64, W_2J = 128, W_JJ = 256;

template <class T> struct Invariants { T I1, I2, J; };
template <class T> struct Slopes { T w1, w2, wJ, w11, w12, w22, w1J, w2J, wJJ; };

// left: F F^T, which has the invariants of C.
template <unsigned HAS, class T> INLINE Invariants<T> invariants(const mat<T>& left, T J) {
    Invariants<T> q = {trace(left), T{}, J};
    if constexpr ((HAS & (W_2 | W_12 | W_22 | W_2J)) != 0) {
        const T* m = left.m;
        q.I2 = m[0] * m[4] - m[1] * m[3] + m[0] * m[8] - m[2] * m[6] + m[4] * m[8] - m[5] * m[7];
    }
    return q;
}

// Gradients of I1, I2 and J at each corner.
template <unsigned HAS, class T>
INLINE void invariant_gradients(const Invariants<T>& q, const mat<T>& left, const Tetrahedron<T>& t, vec<T> (&a1)[4], vec<T> (&a2)[4]) {
    UNROLL for (int i = 1; i < 4; ++i) {
        a1[i] = (entry<T>)2 * t.g[i];
        if constexpr ((HAS & (W_2 | W_12 | W_22 | W_2J)) != 0) a2[i] = (entry<T>)2 * (q.I1 * t.g[i] - mul(left, t.g[i]));
        else a2[i] = vec<T>{};
    }
    set_corner_0(a1);
    set_corner_0(a2);
}

// f_i = factor sum_p W_p a^p_i
template <unsigned HAS, class T>
INLINE void forces(const Slopes<T>& w, const Invariants<T>& q, const mat<T>& left, const Tetrahedron<T>& t, T factor, vec<T> (&f)[4]) {
    vec<T> a1[4], a2[4];
    invariant_gradients<HAS>(q, left, t, a1, a2);
    UNROLL for (int i = 1; i < 4; ++i) {
        f[i] = (factor * w.w1) * a1[i];
        if constexpr ((HAS & W_2) != 0) f[i] = f[i] + (factor * w.w2) * a2[i];
        if constexpr ((HAS & W_J) != 0) f[i] = f[i] + (factor * w.wJ) * t.area[i];
    }
    set_corner_0(f);
}

// k { sum_pq W_pq a^p_i a^q_j^T + sum_p W_p d2q_p / dQ_i dQ_j } of every edge.
template <unsigned HAS, class T>
INLINE void invariant_edges(const Slopes<T>& w, const Invariants<T>& q, const mat<T>& left, const Tetrahedron<T>& t, T k, Blocks6<T>& B) {
    constexpr bool first = (HAS & (W_11 | W_12 | W_1J)) != 0, second = (HAS & (W_12 | W_22 | W_2J)) != 0;
    constexpr bool third = (HAS & (W_1J | W_2J | W_JJ)) != 0;
    vec<T> a1[4], a2[4], u1[4], u2[4], uJ[4];
    invariant_gradients<HAS>(q, left, t, a1, a2);
    UNROLL for (int i = 0; i < 4; ++i) {  // sum_p W_pq a^p_i
        u1[i] = u2[i] = uJ[i] = vec<T>{};
        if constexpr ((HAS & W_11) != 0) u1[i] = (k * w.w11) * a1[i];
        if constexpr ((HAS & W_12) != 0) { u1[i] = u1[i] + (k * w.w12) * a2[i]; u2[i] = (k * w.w12) * a1[i]; }
        if constexpr ((HAS & W_22) != 0) u2[i] = u2[i] + (k * w.w22) * a2[i];
        if constexpr ((HAS & W_1J) != 0) { u1[i] = u1[i] + (k * w.w1J) * t.area[i]; uJ[i] = (k * w.w1J) * a1[i]; }
        if constexpr ((HAS & W_2J) != 0) { u2[i] = u2[i] + (k * w.w2J) * t.area[i]; uJ[i] = uJ[i] + (k * w.w2J) * a2[i]; }
        if constexpr ((HAS & W_JJ) != 0) uJ[i] = uJ[i] + (k * w.wJJ) * t.area[i];
    }
    T two1 = 2 * k * w.w1, two2 = 2 * k * w.w2;
    UNROLL for (int e = 0; e < 6; ++e) {
        const int i = edge_first(e), j = edge_second(e);
        mat<T>& M = B.e[e];
        T DD = dot(t.D[i], t.D[j]);
        M = mat<T>{};
        if constexpr ((HAS & W_2) != 0) {
            T shared = two2 * DD;
            UNROLL for (int a = 0; a < 9; ++a) M.m[a] = -shared * left.m[a];
            add_outer(M, (2 * two2) * t.g[i], t.g[j]);
            add_outer(M, -two2 * t.g[j], t.g[i]);
            add_identity(M, two1 * DD + two2 * (q.I1 * DD - dot(t.g[i], t.g[j])));
        } else {
            add_identity(M, two1 * DD);
        }
        if constexpr (first) add_outer(M, u1[i], a1[j]);
        if constexpr (second) add_outer(M, u2[i], a2[j]);
        if constexpr (third) add_outer(M, uJ[i], t.area[j]);
        if constexpr ((HAS & W_J) != 0) subtract_cross(M, (k * w.wJ) * opposite(t.q, e));
    }
}

// d2W/dF2 in the principal frame, without a division: nothing is to be guarded where stretches meet.
template <unsigned HAS, class T> INLINE Modes<T> modes(const Slopes<T>& w, const T (&s)[3]) {
    Modes<T> m;
    T q1[3], q2[3], qJ[3], diagonal[3], across[3];
    UNROLL for (int k = 0; k < 3; ++k) {
        T si = s[(k + 1) % 3], sj = s[(k + 2) % 3], sk = s[k], product = si * sj;
        m.twist[k] = m.flip[k] = diagonal[k] = 2 * w.w1;
        across[k] = T{};
        q1[k] = 2 * sk;
        qJ[k] = product;
        if constexpr ((HAS & (W_2 | W_12 | W_22 | W_2J)) != 0) q2[k] = 2 * sk * (si * si + sj * sj);
        else q2[k] = T{};
        if constexpr ((HAS & W_2) != 0) {
            m.twist[k] += 2 * w.w2 * (sk * sk + product);
            m.flip[k] += 2 * w.w2 * (sk * sk - product);
            diagonal[k] += 2 * w.w2 * (si * si + sj * sj);
            across[k] = 4 * w.w2 * product;
        }
        if constexpr ((HAS & W_J) != 0) {
            m.twist[k] += w.wJ * sk;
            m.flip[k] -= w.wJ * sk;
            across[k] += w.wJ * sk;
        }
    }
    UNROLL for (int a = 0; a < 3; ++a) {
        UNROLL for (int b = a; b < 3; ++b) {
            T h = a == b ? diagonal[a] : across[(6 - a - b) % 3];
            if constexpr ((HAS & W_11) != 0) h += w.w11 * q1[a] * q1[b];
            if constexpr ((HAS & W_12) != 0) h += w.w12 * (q1[a] * q2[b] + q2[a] * q1[b]);
            if constexpr ((HAS & W_22) != 0) h += w.w22 * q2[a] * q2[b];
            if constexpr ((HAS & W_1J) != 0) h += w.w1J * (q1[a] * qJ[b] + qJ[a] * q1[b]);
            if constexpr ((HAS & W_2J) != 0) h += w.w2J * (q2[a] * qJ[b] + qJ[a] * q2[b]);
            if constexpr ((HAS & W_JJ) != 0) h += w.wJJ * qJ[a] * qJ[b];
            m.stretch[a == 0 ? b : a + b + 1] = h;
        }
    }
    return m;
}
