// SPDX-License-Identifier: MIT
// Loads on surfaces (traction.py): dead forces on nodes, and pressures that follow the normals of triangles.
#include "mat3.cuh"

struct Areas {
    int n;              // elements: loaded triangles
    const int* corner;  // (n, 3) nodes, outward by the right-hand rule
    const real* x;      // (nodes, 3) [m]
    real* area;         // (n, 3) out: outward normal times area [m2]
};

KERNEL(areas, Areas) {
    const int *c = p.corner + 3 * i;
    const vec3 a = load3(p.x, c[0]);
    store3(p.area, i, (real)0.5 * cross(load3(p.x, c[1]) - a, load3(p.x, c[2]) - a));
}

struct Load {
    int n;                // nodes
    const int* start;     // (n + 1,) into the entries
    const int* triangle;  // (start[n],) of each entry
    const real* share;    // (start[n],) pressure that the node takes of it [Pa]
    const real* area;     // (triangles, 3) [m2]
    const real* dead;     // (n, 3) forces that do not follow the surface [N]
    real h;               // world.force_coefficient [s]
    int accumulate;       // 0: write load, 1: add to what another effect wrote
    own<real> b;          // (n, 3) in, out: += h f [N s]
    real* load;           // (n, 3) out: f, for the energy balance [N]
};

INLINE void load_add(const Load& p, int, int k, local* sum) {
    const vec3 area = load3(p.area, p.triangle[k]);
    sum[0] -= p.share[k] * area.x;
    sum[1] -= p.share[k] * area.y;
    sum[2] -= p.share[k] * area.z;
}

INLINE void load_put(const Load& p, int i, const local* sum) {
    const vec3 f = load3(p.dead, i) + vec3{sum[0], sum[1], sum[2]};
    store3(p.b, i, load3(p.b, i) + p.h * f);
    store3(p.load, i, p.accumulate ? load3(p.load, i) + f : f);
}

SUM_KERNEL(load, Load, 3)
