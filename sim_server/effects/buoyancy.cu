// SPDX-License-Identifier: MIT
// Pressure of a fluid at rest on surfaces (formulas: buoyancy.py).
#include "mat3.cuh"

struct Wetted {
    int n;                // elements: triangles
    const int* corner;    // (n, 3) nodes, outward by the right-hand rule
    const real* x;        // (nodes, 3) [m]
    const real* fluid;    // (n, 2) level [m], density [kg/m3]
    const real* gravity;  // (3,) [m/s2]
    real* push;           // (n, 3, 3) out: force on each corner [N]
};

// Of a triangle with depths d at its corners the part on whose side corner i alone lies, cut where d = 0: integrals of d times the
// shape functions of i, j, k over it, in parts of the triangle's area.
INLINE void cut(real d, real dj, real dk, real* i, real* j, real* k) {
    const real t = d / (d - dj), s = d / (d - dk), part = d * t * s;
    *i += part * ((real)1 / 3 - (t + s) / 12);
    *j += part * t / 12;
    *k += part * s / 12;
}

KERNEL(wetted, Wetted) {
    const vec3 g = load3(p.gravity, 0);
    const real size = sqrt(dot(g, g)), level = p.fluid[2 * i];
    const vec3 up = (-1 / (size + (real)1e-37)) * g;
    vec3 x[3];
    real d[3], w[3] = {0, 0, 0};
    int wet = 0;
    for (int a = 0; a < 3; ++a) {
        x[a] = load3(p.x, p.corner[3 * i + a]);
        d[a] = level - dot(up, x[a]);
        wet += d[a] > 0;
    }
    if (wet >= 2)
        for (int a = 0; a < 3; ++a) w[a] = (d[0] + d[1] + d[2] + d[a]) / 12;
    for (int a = 0; a < 3; ++a) {
        const int b = a == 2 ? 0 : a + 1, c = a == 0 ? 2 : a - 1;
        const bool alone = wet == 1 ? d[a] > 0 : wet == 2 && !(d[a] > 0);
        if (!alone) continue;
        real part[3] = {0, 0, 0};
        if (d[a] != 0) cut(d[a], d[b], d[c], part, part + 1, part + 2);
        const real sign = wet == 1 ? 1 : -1;
        w[a] += sign * part[0];
        w[b] += sign * part[1];
        w[c] += sign * part[2];
    }
    const vec3 area = (real)0.5 * cross(x[1] - x[0], x[2] - x[0]);
    for (int a = 0; a < 3; ++a) store3(p.push, 3 * i + a, (-p.fluid[2 * i + 1] * size * w[a]) * area);
}

struct Buoyancy {
    int n;             // nodes
    const int* start;  // (n + 1,) into slot
    const int* slot;   // (start[n],) 3 t + a: the node is corner a of triangle t
    const real* push;  // (triangles, 3, 3) [N]
    real h;            // world.force_coefficient [s]
    int accumulate;    // 0: write load, 1: add to what another effect wrote
    own<real> b;       // (n, 3) in, out: += h f [N s]
    real* load;        // (n, 3) out: f, for the energy balance [N]
};

INLINE void lift_add(const Buoyancy& p, int, int k, local* sum) {
    const vec3 f = load3(p.push, p.slot[k]);
    sum[0] += f.x;
    sum[1] += f.y;
    sum[2] += f.z;
}

INLINE void lift_put(const Buoyancy& p, int i, const local* sum) {
    const vec3 f = {sum[0], sum[1], sum[2]};
    store3(p.b, i, load3(p.b, i) + p.h * f);
    store3(p.load, i, p.accumulate ? load3(p.load, i) + f : f);
}

SUM_KERNEL(lift, Buoyancy, 3)
