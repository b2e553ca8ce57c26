// SPDX-License-Identifier: MIT
// W = shear sum_i a_i / segments^(i - 1) (J^(-2 i / 3) I1^i - 3^i) + bulk/2 ln^2 J, i = 1 .. 5
constexpr int CONSTANTS = 3;  // shear [Pa], segments [-], bulk [Pa]
constexpr unsigned HAS = W_1 | W_J | W_11 | W_1J | W_JJ;
constexpr bool REFUSES = true;

INLINE constexpr double chain(int i) {
    return i == 1 ? 1. / 2 : i == 2 ? 1. / 20 : i == 3 ? 11. / 1050 : i == 4 ? 19. / 7000 : 519. / 673750;
}

template <class T> INLINE T density(const T (&c)[CONSTANTS], const Invariants<T>& q, T floor) {
    Thirds<T> r = thirds(q.J, floor);
    T L = logarithm(q.J, floor).f, W = (entry<T>)0.5 * c[2] * L * L, factor = c[0], power = q.I1;
    entry<T> rest = 3;
    UNROLL for (int i = 1; i <= 5; ++i) {
        W += (entry<T>)chain(i) * factor * (r.minus(i).f * power - rest);
        factor = factor / c[1];
        power *= q.I1;
        rest *= 3;
    }
    return W;
}

template <class T> INLINE Slopes<T> slopes(const T (&c)[CONSTANTS], const Invariants<T>& q, T floor) {
    Thirds<T> r = thirds(q.J, floor);
    Jet<T> L = logarithm(q.J, floor);
    Slopes<T> w = {};
    w.wJ = c[2] * L.f * L.d;
    w.wJJ = c[2] * (L.d * L.d + L.f * L.dd);
    T factor = c[0], inverse = 1 / c[1], p2 = T{}, p1 = T{} + 1;  // I1^(i - 2), I1^(i - 1)
    UNROLL for (int i = 1; i <= 5; ++i) {
        Jet<T> A = r.minus(i);
        T a = (entry<T>)chain(i) * factor;
        w.w1 += (entry<T>)i * a * A.f * p1;
        w.w1J += (entry<T>)i * a * A.d * p1;
        w.w11 += (entry<T>)(i * (i - 1)) * a * A.f * p2;
        w.wJ += a * A.d * p1 * q.I1;
        w.wJJ += a * A.dd * p1 * q.I1;
        factor *= inverse;
        p2 = p1;
        p1 *= q.I1;
    }
    return w;
}

// What patches take from it (elements = "patch"): U = bulk/2 ln^2 J
template <class T> INLINE Jet<T> volumetric(T bulk, T J, T floor) { return half_squared_logarithm(bulk, J, floor); }
