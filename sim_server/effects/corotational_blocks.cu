// SPDX-License-Identifier: MIT
// Sums the element tangents of corotational tetrahedra block by block: with g_a the scaled rotated gradient of node a,
// h (h + beta) K_ab = (lambda / mu) g_a g_b^T + g_b g_a^T + (g_a . g_b) I. A block gathers its elements from a list made once
// per topology: no atomics, the same sum in the same order every time, and no 12x12 matrix is ever formed.
#include "mat3.cuh"

struct Blocks {
    int n;               // blocks on and above the diagonal
    int accumulate;      // 0: write, 1: add to what another effect wrote
    const int* start;    // (n + 1,) into pairs
    const int* pairs;    // (start[n], 2) slots 4 e + a and 4 e + b of the element's corners at the block's row and column
    const real* ratio;   // (elements,) lambda / mu
    const real* spread;  // (elements, 4, 3)
    real* sums;          // (n, 3, 3) out, world frame [kg]
};

INLINE void blocks_add(const Blocks& p, int, int k, real* s) {
    int sa = p.pairs[2 * k], sb = p.pairs[2 * k + 1];
    vec3 a = load3(p.spread, sa), b = load3(p.spread, sb);
    real w = p.ratio[sa >> 2];
    real wx = w * a.x, wy = w * a.y, wz = w * a.z, d = dot(a, b);
    s[0] += wx * b.x + b.x * a.x + d; s[1] += wx * b.y + b.x * a.y;     s[2] += wx * b.z + b.x * a.z;
    s[3] += wy * b.x + b.y * a.x;     s[4] += wy * b.y + b.y * a.y + d; s[5] += wy * b.z + b.y * a.z;
    s[6] += wz * b.x + b.z * a.x;     s[7] += wz * b.y + b.z * a.y;     s[8] += wz * b.z + b.z * a.z + d;
}

INLINE void blocks_put(const Blocks& p, int i, const real* sum) {
    real* s = p.sums + 9 * i;
    for (int m = 0; m < 9; ++m) s[m] = p.accumulate ? s[m] + sum[m] : sum[m];
}

SUM_KERNEL(blocks, Blocks, 9)
