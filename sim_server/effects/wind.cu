// SPDX-License-Identifier: MIT
// Drag of a fluid on surfaces (formulas: wind.py).
#include "mat3.cuh"

struct Faces {
    int n;              // elements: triangles
    const int* corner;  // (n, 3) nodes, outward by the right-hand rule
    const real* x;      // (nodes, 3) [m]
    real* face;         // (n, 4) out: outward normal, a third of the area [m2]
};

KERNEL(faces, Faces) {
    const int* c = p.corner + 3 * i;
    const vec3 a = load3(p.x, c[0]), area = (real)0.5 * cross(load3(p.x, c[1]) - a, load3(p.x, c[2]) - a);
    const real size = sqrt(dot(area, area)), inverse = 1 / (size + (real)1e-37);
    p.face[4 * i] = inverse * area.x;
    p.face[4 * i + 1] = inverse * area.y;
    p.face[4 * i + 2] = inverse * area.z;
    p.face[4 * i + 3] = size / 3;
}

// Force of a corner's part of a triangle, and minus its derivative by v, upper triangle.
// law: velocity of the fluid [m/s], half its density times the coefficients of pressure and of friction [kg/m3]
INLINE void drag_of(const real* face, const real* law, vec3 v, local* sum) {
    const vec3 n = {face[0], face[1], face[2]}, u = vec3{law[0], law[1], law[2]} - v;
    const real across = dot(u, n), area = face[3];
    const vec3 t = u - across * n;
    const real inward = across < 0 ? -across : (real)0, push = area * law[3] * inward;  // windward faces alone
    const real slip = sqrt(dot(t, t)), rub = area * law[4] * slip, turn = slip > 0 ? area * law[4] / slip : (real)0;
    const vec3 f = (-push * inward) * n + rub * t;
    sum[0] += f.x; sum[1] += f.y; sum[2] += f.z;
    const real d = 2 * push - rub;
    sum[3] += rub + d * n.x * n.x + turn * t.x * t.x;
    sum[4] += d * n.x * n.y + turn * t.x * t.y;
    sum[5] += d * n.x * n.z + turn * t.x * t.z;
    sum[6] += rub + d * n.y * n.y + turn * t.y * t.y;
    sum[7] += d * n.y * n.z + turn * t.y * t.z;
    sum[8] += rub + d * n.z * n.z + turn * t.z * t.z;
}

struct Drag {
    int n;              // nodes
    const int* start;   // (n + 1,) into slot
    const int* slot;    // (start[n],) 3 t + a: the node is corner a of triangle t
    const real* face;   // (triangles, 4)
    const real* law;    // (triangles, 5)
    const real* v;      // (n, 3) [m/s]
    real moves;         // 1, or 0 where velocities are none (quasi-static)
    real h;             // world.force_coefficient [s]
    int accumulate;     // 0: write load, 1: add to what another effect wrote
    own<real> b;        // (n, 3) in, out: += h f [N s]
    own<local> block;   // (n, 6) in, out: upper triangle of the node's own block of A, += h (-df/dv) [kg]
    real* load;         // (n, 3) out: f, for the energy balance [N]
};

INLINE void drag_add(const Drag& p, int i, int k, local* sum) {
    const int t = p.slot[k] / 3;
    drag_of(p.face + 4 * t, p.law + 5 * t, p.moves * load3(p.v, i), sum);
}

INLINE void drag_put(const Drag& p, int i, const local* sum) {
    const vec3 f = {sum[0], sum[1], sum[2]};
    store3(p.b, i, load3(p.b, i) + p.h * f);
    store3(p.load, i, p.accumulate ? load3(p.load, i) + f : f);
    const local scale = (local)(p.h * p.moves);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + scale * sum[3 + m]);
}

SUM_KERNEL(drag, Drag, 9)

struct DragForces {
    int n;              // nodes
    const int* start;   // (n + 1,) into slot
    const int* slot;    // (start[n],)
    const real* face;   // (triangles, 4)
    const real* law;    // (triangles, 5)
    const real* v;      // (n, 3) [m/s]
    real moves;         // 1, or 0
    real h;             // world.force_coefficient [s]
    int accumulate;     // 0: write load, 1: add to what another effect wrote
    own<real> b;        // (n, 3) in, out: += h f [N s]
    real* load;         // (n, 3) out: f [N]
};

INLINE void forces_add(const DragForces& p, int i, int k, local* sum) {
    const int t = p.slot[k] / 3;
    drag_of(p.face + 4 * t, p.law + 5 * t, p.moves * load3(p.v, i), sum);
}

INLINE void forces_put(const DragForces& p, int i, const local* sum) {
    const vec3 f = {sum[0], sum[1], sum[2]};
    store3(p.b, i, load3(p.b, i) + p.h * f);
    store3(p.load, i, p.accumulate ? load3(p.load, i) + f : f);
}

SUM_KERNEL(forces, DragForces, 9)
