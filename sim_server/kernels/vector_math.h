// SPDX-License-Identifier: MIT
// log, exp and cbrt of a vector of doubles, within two units in the last place. Computed in all lanes at once: the functions of the
// system take one number at a time and spill all registers. kernel.h includes this where vectors are of double.
#pragma once

typedef long long bits __attribute__((vector_size(REGISTER)));
constexpr double LN2_HIGH = 0x1.62e42fee00000p-1, LN2_LOW = 0x1.a39ef35793c76p-33;  // ln 2 in two parts, the first of 32 bits

// 2^k m = a with m from sqrt(1/2) to sqrt(2); log a = k ln 2 + f - (f^2 / 2 - s (f^2 / 2 + R)), f = m - 1, s = f / (2 + f) and
// R = 2 s^2 (1/3 + s^2/5 + s^4/7 + ...), the series of 2 artanh s = log m.
INLINE number log(number a) {
    const number least = number{} + 0x1p-1022, infinite = number{} + __builtin_inf(), none = number{} + __builtin_nan("");
    const bits shift = (bits)(number{} + 1) - (bits)(number{} + 0x1.6a09e667f3bcdp-1);  // of 1 over sqrt(1/2)
    number tiny = a < least ? a * 0x1p54 : a;
    bits whole = (bits)tiny + shift;
    bits k = (whole >> 52) - 1023;
    number m = (number)(((whole & 0xfffffffffffffLL) | 0x3ff0000000000000LL) - shift);
    number power = (number)((k + 0x4338000000000000LL)) - 0x1.8p52;  // k as a number
    power = a < least ? power - 54 : power;
    number f = m - 1, half = 0.5 * f * f, s = f / (2 + f), z = s * s;
    number R = z * 2. / 23 + 2. / 21;
    R = R * z + 2. / 19;
    R = R * z + 2. / 17;
    R = R * z + 2. / 15;
    R = R * z + 2. / 13;
    R = R * z + 2. / 11;
    R = R * z + 2. / 9;
    R = R * z + 2. / 7;
    R = R * z + 2. / 5;
    R = z * (R * z + 2. / 3);
    number r = power * LN2_HIGH - ((half - (s * (half + R) + power * LN2_LOW)) - f);
    r = a < infinite ? r : a;
    return a > 0 ? r : a == 0 ? -infinite : none;
}

// 2^k exp(r), |r| <= ln 2 / 2, by the series of exp.
INLINE number exp(number a) {
    const number highest = number{} + 1000, lowest = number{} - 1000;  // beyond what there are numbers for
    number x = a > highest ? highest : a < lowest ? lowest : a;
    number shifted = x * 0x1.71547652b82fep0 + 0x1.8p52, k = shifted - 0x1.8p52;
    number r = (x - k * LN2_HIGH) - k * LN2_LOW;
    number e = r * (1. / 6227020800) + 1. / 479001600;
    e = e * r + 1. / 39916800;
    e = e * r + 1. / 3628800;
    e = e * r + 1. / 362880;
    e = e * r + 1. / 40320;
    e = e * r + 1. / 5040;
    e = e * r + 1. / 720;
    e = e * r + 1. / 120;
    e = e * r + 1. / 24;
    e = e * r + 1. / 6;
    e = e * r + 0.5;
    e = 1 + (r + r * r * e);
    bits whole = (bits)shifted - 0x4338000000000000LL, part = whole >> 1, rest = whole - part;  // 2^k in two factors
    return e * (number)((part + 1023) << 52) * (number)((rest + 1023) << 52);
}

// Of normal numbers above 0; a step of Newton's takes the error of the two out.
INLINE number cbrt(number a) {
    number r = exp(log(a) * (1. / 3));
    return r - (r * r * r - a) / (3 * r * r);
}
