// SPDX-License-Identifier: MIT
// Between L as a worker sends it and the dense inverse that the solver applies (expand.py).
// GPU only: it stores float16 by PTX.
#include "kernel.h"

struct Spread {
    int n;               // values of L
    const float* values; // (n,)
    const int* row;      // (n,) row of L
    const int* column;   // (n,)
    int size;            // degrees of freedom
    float* dense;        // (size, size) out, row major: L below zeros
};

KERNEL(spread, Spread) { p.dense[(long long)p.row[i] * p.size + p.column[i]] = p.values[i]; }

struct Scale {
    int n;                   // degrees of freedom
    const float* inverse;    // (n, n) of the permuted matrix
    const int* place;        // (n,) row of L of each degree of freedom
    float* scale;            // (n,) out
};

KERNEL(scale, Scale) {
    long long k = p.place[i];
    p.scale[i] = sqrt(p.inverse[k * p.n + k]);
}

struct Store {
    int n;                   // size * stride / 2 pairs of entries
    const float* inverse;    // (size, size) of the permuted matrix
    const int* place;        // (size,) row of L of each degree of freedom
    const float* scale;      // (size,) of each degree of freedom: square root of the inverse's diagonal
    int size;
    int stride;              // entries per stored row
    int* stored;             // (size, stride / 2) out: two float16 each
};

INLINE int halves(float lo, float hi) {
    int word;
    asm("{.reg .b16 a, b; cvt.rn.f16.f32 a, %1; cvt.rn.f16.f32 b, %2; mov.b32 %0, {a, b};}" : "=r"(word) : "f"(lo), "f"(hi));
    return word;
}

KERNEL(store, Store) {
    int pairs = p.stride / 2, r = i / pairs, c = 2 * (i % pairs);
    const float* row = p.inverse + (long long)p.place[r] * p.size;
    float lo = c < p.size ? row[p.place[c]] / (p.scale[r] * p.scale[c]) : 0;
    float hi = c + 1 < p.size ? row[p.place[c + 1]] / (p.scale[r] * p.scale[c + 1]) : 0;
    p.stored[i] = halves(lo, hi);
}
