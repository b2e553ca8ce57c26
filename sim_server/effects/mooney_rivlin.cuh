// SPDX-License-Identifier: MIT
// W = c1 (J^-2/3 I1 - 3) + c2 (J^-4/3 I2 - 3) + bulk/2 ln^2 J
constexpr int CONSTANTS = 3;  // c1, c2, bulk [Pa]
constexpr unsigned HAS = W_1 | W_2 | W_J | W_1J | W_2J | W_JJ;
constexpr bool REFUSES = true;

template <class T> INLINE T density(const T (&c)[CONSTANTS], const Invariants<T>& q, T floor) {
    Thirds<T> r = thirds(q.J, floor);
    T L = logarithm(q.J, floor).f;
    return c[0] * (r.minus(1).f * q.I1 - 3) + c[1] * (r.minus(2).f * q.I2 - 3) + (entry<T>)0.5 * c[2] * L * L;
}

template <class T> INLINE Slopes<T> slopes(const T (&c)[CONSTANTS], const Invariants<T>& q, T floor) {
    Thirds<T> r = thirds(q.J, floor);
    Jet<T> A = r.minus(1), B = r.minus(2), L = logarithm(q.J, floor);
    Slopes<T> w = {};
    w.w1 = c[0] * A.f;
    w.w1J = c[0] * A.d;
    w.w2 = c[1] * B.f;
    w.w2J = c[1] * B.d;
    w.wJ = w.w1J * q.I1 + w.w2J * q.I2 + c[2] * L.f * L.d;
    w.wJJ = c[0] * A.dd * q.I1 + c[1] * B.dd * q.I2 + c[2] * (L.d * L.d + L.f * L.dd);
    return w;
}

// What patches take from it (elements = "patch"): U = bulk/2 ln^2 J
template <class T> INLINE Jet<T> volumetric(T bulk, T J, T floor) { return half_squared_logarithm(bulk, J, floor); }
