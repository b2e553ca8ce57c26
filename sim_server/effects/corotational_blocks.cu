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

KERNEL(blocks, Blocks) {
    real s0 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0, s5 = 0, s6 = 0, s7 = 0, s8 = 0;
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) {
        int sa = p.pairs[2 * k], sb = p.pairs[2 * k + 1];
        vec3 a = load3(p.spread, sa), b = load3(p.spread, sb);
        real w = p.ratio[sa >> 2];
        real wx = w * a.x, wy = w * a.y, wz = w * a.z, d = dot(a, b);
        s0 += wx * b.x + b.x * a.x + d; s1 += wx * b.y + b.x * a.y;     s2 += wx * b.z + b.x * a.z;
        s3 += wy * b.x + b.y * a.x;     s4 += wy * b.y + b.y * a.y + d; s5 += wy * b.z + b.y * a.z;
        s6 += wz * b.x + b.z * a.x;     s7 += wz * b.y + b.z * a.y;     s8 += wz * b.z + b.z * a.z + d;
    }
    real* s = p.sums + 9 * i;
    if (p.accumulate) {
        s0 += s[0]; s1 += s[1]; s2 += s[2]; s3 += s[3]; s4 += s[4]; s5 += s[5]; s6 += s[6]; s7 += s[7]; s8 += s[8];
    }
    s[0] = s0; s[1] = s1; s[2] = s2; s[3] = s3; s[4] = s4; s[5] = s5; s[6] = s6; s[7] = s7; s[8] = s8;
}
