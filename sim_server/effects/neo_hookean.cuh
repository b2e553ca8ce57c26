// SPDX-License-Identifier: MIT
// W = mu/2 (I1 - 3) - mu ln J + lambda/2 ln^2 J
constexpr int CONSTANTS = 2;  // lambda, mu [Pa]
constexpr unsigned HAS = W_1 | W_J | W_JJ;
constexpr bool REFUSES = true;

template <class T> INLINE T density(const T (&c)[CONSTANTS], const Invariants<T>& q, T floor) {
    T L = logarithm(q.J, floor).f;
    return (entry<T>)0.5 * (c[1] * (q.I1 - 3) + c[0] * L * L) - c[1] * L;
}

template <class T> INLINE Slopes<T> slopes(const T (&c)[CONSTANTS], const Invariants<T>& q, T floor) {
    Jet<T> L = logarithm(q.J, floor);
    T s = c[0] * L.f - c[1];
    Slopes<T> w = {};
    w.w1 = (entry<T>)0.5 * c[1];
    w.wJ = s * L.d;
    w.wJJ = s * L.dd + c[0] * L.d * L.d;
    return w;
}

// What patches take from it (elements = "patch"): U = bulk/2 ln^2 J, bulk = lambda
template <class T> INLINE Jet<T> volumetric(T bulk, T J, T floor) { return half_squared_logarithm(bulk, J, floor); }
