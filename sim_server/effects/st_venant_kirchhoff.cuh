// SPDX-License-Identifier: MIT
// W = lambda/2 tr^2 E + mu tr E^2 = lambda/8 (I1 - 3)^2 + mu/4 (I1^2 - 2 I2 - 2 I1 + 3)
constexpr int CONSTANTS = 2;  // lambda, mu [Pa]
constexpr unsigned HAS = W_1 | W_2 | W_11;
constexpr bool REFUSES = false;

template <class T> INLINE T density(const T (&c)[CONSTANTS], const Invariants<T>& q, T) {
    T e = q.I1 - 3;
    return (entry<T>)0.125 * c[0] * e * e + (entry<T>)0.25 * c[1] * (e * e + 4 * e - 2 * (q.I2 - 3));
}

template <class T> INLINE Slopes<T> slopes(const T (&c)[CONSTANTS], const Invariants<T>& q, T) {
    Slopes<T> w = {};
    w.w1 = (entry<T>)0.25 * c[0] * (q.I1 - 3) + (entry<T>)0.5 * c[1] * (q.I1 - 1);
    w.w2 = (entry<T>)-0.5 * c[1];
    w.w11 = (entry<T>)0.25 * c[0] + (entry<T>)0.5 * c[1];
    return w;
}
