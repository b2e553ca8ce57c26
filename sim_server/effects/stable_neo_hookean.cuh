// SPDX-License-Identifier: MIT
// W = m/2 (I1 - 3) - m/2 ln((I1 + 1) / 4) + l/2 (J - a)^2 - l/2 (1 - a)^2, a = 1 + 3 m / (4 l)
constexpr int CONSTANTS = 2;  // l, m [Pa]: from lambda, mu by stable_neo_hookean.py
constexpr unsigned HAS = W_1 | W_J | W_11 | W_JJ;
constexpr bool REFUSES = false;

template <class T> INLINE T density(const T (&c)[CONSTANTS], const Invariants<T>& q, T) {
    T d = q.J - 1;  // (J - a)^2 - (1 - a)^2 = d^2 - 2 d (a - 1)
    return (entry<T>)0.5 * (c[1] * (q.I1 - 3 - log((entry<T>)0.25 * (q.I1 + 1))) + c[0] * d * d) - (entry<T>)0.75 * c[1] * d;
}

template <class T> INLINE Slopes<T> slopes(const T (&c)[CONSTANTS], const Invariants<T>& q, T) {
    T inverse = 1 / (q.I1 + 1);
    Slopes<T> w = {};
    w.w1 = (entry<T>)0.5 * c[1] * (1 - inverse);
    w.w11 = (entry<T>)0.5 * c[1] * inverse * inverse;
    w.wJ = c[0] * (q.J - 1) - (entry<T>)0.75 * c[1];
    w.wJJ = c[0];
    return w;
}

// What patches take from it (elements = "patch"): U = bulk/2 (J - 1)^2, bulk = lambda
template <class T> INLINE Jet<T> volumetric(T bulk, T J, T) {
    T d = bulk * (J - 1);
    return {(entry<T>)0.5 * d * (J - 1), d, bulk};
}
