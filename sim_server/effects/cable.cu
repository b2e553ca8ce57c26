// SPDX-License-Identifier: MIT
// Cables through nodes: directions, tensions, and forces (formulas: cable.py). cable_blocks.cu has what they add off the diagonal.
#include "mat3.cuh"

struct Segments {
    int n;          // cells: segments
    const int* ends;  // (n, 2) nodes
    const real* x;  // (nodes, 3) [m]
    const real* v;  // (nodes, 3) world.damping_velocity [m/s]
    real* segment;  // (n, 8) out: unit vector e, length [m], change of v along the segment [m/s]
};

// Ends that meet have no direction.
KERNEL(segments, Segments) {
    const int a = p.ends[2 * i], b = p.ends[2 * i + 1];
    const vec3 d = load3(p.x, b) - load3(p.x, a), rate = load3(p.v, b) - load3(p.v, a);
    const real length = sqrt(dot(d, d));
    const vec3 e = (1 / (length + (real)1e-37)) * d;
    real* s = p.segment + 8 * (long long)i;
    s[0] = e.x; s[1] = e.y; s[2] = e.z; s[3] = length;
    s[4] = rate.x; s[5] = rate.y; s[6] = rate.z; s[7] = 0;
}

struct Tensions {
    int n;                // patches: cables
    const int* start;     // (n + 1,) into segments
    const real* segment;  // (segments, 8)
    const real* law;      // (n, 3) tension [N]; stiffness [N/m], 0: the tension is given; length without tension [m]
    real* state;          // (n, 4) out: tension [N], length [m], stiffness in force [N/m], change of length by v [m/s]
};

KERNEL(tensions, Tensions) {
    real length = 0, rate = 0;
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) {
        const real* s = p.segment + 8 * (long long)k;
        length += s[3];
        rate += s[0] * s[4] + s[1] * s[5] + s[2] * s[6];
    }
    const real *law = p.law + 3 * i, stretch = length - law[2];
    const bool pulls = law[1] > 0 && stretch > 0;
    p.state[4 * i] = pulls ? law[1] * stretch : law[0];
    p.state[4 * i + 1] = length;
    p.state[4 * i + 2] = pulls ? law[1] : (real)0;
    p.state[4 * i + 3] = rate;
}

struct Guides {
    int n;                  // elements: nodes of one cable after another
    const int* cable;       // (n,)
    const int* around;      // (n, 2) segments before and after, -1: none
    const real* segment;    // (segments, 8)
    const real* state;      // (cables, 4)
    const real* law;        // (cables, 3)
    const real* coefficient;  // (cables,) h (c + beta): factor of K in A [s2]
    real h;                 // world.force_coefficient [s]
    real* slope;            // (n, 3) out: g = dL/dx
    real* row;              // (n, 12) out: impulse [N s], force that counts as a load [N], upper triangle of the own block [kg]
};

// row -= coefficient T / l (I - e e^T) applied to v, with sign -1 at the end of a segment; own += the matrix
INLINE void across(const real* s, real k, real sign, real* row) {
    const real along = s[0] * s[4] + s[1] * s[5] + s[2] * s[6];
    for (int m = 0; m < 3; ++m) row[m] += sign * k * (s[4 + m] - along * s[m]);
    row[6] += k * (1 - s[0] * s[0]); row[7] -= k * s[0] * s[1]; row[8] -= k * s[0] * s[2];
    row[9] += k * (1 - s[1] * s[1]); row[10] -= k * s[1] * s[2]; row[11] += k * (1 - s[2] * s[2]);
}

KERNEL(guides, Guides) {
    const int c = p.cable[i], before = p.around[2 * i], after = p.around[2 * i + 1];
    const real *state = p.state + 4 * c, factor = p.coefficient[c], k = factor * state[2];
    real g[3] = {0, 0, 0}, row[12];
    for (int m = 0; m < 12; ++m) row[m] = 0;
    for (int which = 0; which < 2; ++which) {
        const int at_segment = which ? after : before;
        if (at_segment < 0) continue;
        const real *s = p.segment + 8 * (long long)at_segment, sign = which ? 1 : -1;
        for (int m = 0; m < 3; ++m) g[m] -= sign * s[m];
        if (s[3] > 0) across(s, factor * state[0] / s[3], sign, row);
    }
    const bool given = p.law[3 * c + 1] == 0;
    for (int m = 0; m < 3; ++m) {
        row[m] -= (p.h * state[0] + k * state[3]) * g[m];
        row[3 + m] = given ? -state[0] * g[m] : (real)0;
        p.slope[3 * i + m] = g[m];
    }
    row[6] += k * g[0] * g[0]; row[7] += k * g[0] * g[1]; row[8] += k * g[0] * g[2];
    row[9] += k * g[1] * g[1]; row[10] += k * g[1] * g[2]; row[11] += k * g[2] * g[2];
    for (int m = 0; m < 12; ++m) p.row[12 * (long long)i + m] = row[m];
}

struct CableNodes {
    int n;              // nodes
    const int* start;   // (n + 1,) into guide
    const int* guide;   // (start[n],)
    const real* row;    // (guides, 12)
    int accumulate;     // 0: write load, 1: add to what another effect wrote
    own<real> b;        // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;   // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
    real* load;         // (n, 3) out: forces of given tensions, for the energy balance [N]
};

INLINE void gather_add(const CableNodes& p, int, int k, local* sum) {
    const real* row = p.row + 12 * (long long)p.guide[k];
    for (int m = 0; m < 12; ++m) sum[m] += row[m];
}

INLINE void gather_put(const CableNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 3; ++m) p.load[3 * i + m] = p.accumulate ? p.load[3 * i + m] + sum[3 + m] : sum[3 + m];
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[6 + m]);
}

SUM_KERNEL(gather, CableNodes, 12)

struct CableForces {
    int n;              // nodes
    const int* start;   // (n + 1,) into guide
    const int* guide;   // (start[n],)
    const real* row;    // (guides, 12)
    int accumulate;     // 0: write load, 1: add to what another effect wrote
    own<real> b;        // (n, 3) in, out: right-hand side, world frame [N s]
    real* load;         // (n, 3) out: forces of given tensions [N]
};

INLINE void forces_add(const CableForces& p, int, int k, local* sum) {
    const real* row = p.row + 12 * (long long)p.guide[k];
    for (int m = 0; m < 6; ++m) sum[m] += row[m];
}

INLINE void forces_put(const CableForces& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 3; ++m) p.load[3 * i + m] = p.accumulate ? p.load[3 * i + m] + sum[3 + m] : sum[3 + m];
}

SUM_KERNEL(forces, CableForces, 6)

struct CableEnergy {
    int n;             // corners: cables
    const int* start;  // (n + 1,) into segments
    const int* ends;   // (segments, 2)
    const real* x;     // (nodes, 3) [m]
    const real* law;   // (n, 3)
    real* energy;      // (n,) out: of those with a stiffness [J]
};

KERNEL(energy, CableEnergy) {
    const real* law = p.law + 3 * i;
    real stretch = -law[2];
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) {
        const vec3 d = load3(p.x, p.ends[2 * k + 1]) - load3(p.x, p.ends[2 * k]);
        stretch += sqrt(dot(d, d));
    }
    p.energy[i] = stretch > 0 ? (real)0.5 * law[1] * stretch * stretch : (real)0;
}
