// SPDX-License-Identifier: MIT
// A vertex and a triangle of surfaces: the nearest point, and when their paths meet; shared by both devices.
#pragma once
#include "shapes.cuh"

// Barycentric coordinates of the point of triangle a, b, c nearest to p (Ericson, Real-Time Collision Detection, 2005, section 5.1.5).
HOST_DEVICE void nearest_on_triangle(const double* p, const double* a, const double* b, const double* c, double* weight) {
    double ab[3], ac[3], ap[3], bp[3], cp[3];
    for (int k = 0; k < 3; ++k) {
        ab[k] = b[k] - a[k]; ac[k] = c[k] - a[k];
        ap[k] = p[k] - a[k]; bp[k] = p[k] - b[k]; cp[k] = p[k] - c[k];
    }
    const double d1 = dot3(ab, ap), d2 = dot3(ac, ap), d3 = dot3(ab, bp), d4 = dot3(ac, bp), d5 = dot3(ab, cp), d6 = dot3(ac, cp);
    const double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
    double v, w;
    if (d1 <= 0 && d2 <= 0) { v = 0; w = 0; }
    else if (d3 >= 0 && d4 <= d3) { v = 1; w = 0; }
    else if (vc <= 0 && d1 >= 0 && d3 <= 0) { v = d1 / (d1 - d3); w = 0; }
    else if (d6 >= 0 && d5 <= d6) { v = 0; w = 1; }
    else if (vb <= 0 && d2 >= 0 && d6 <= 0) { v = 0; w = d2 / (d2 - d6); }
    else if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) { w = (d4 - d3) / (d4 - d3 + d5 - d6); v = 1 - w; }
    else { v = vb / (va + vb + vc); w = vc / (va + vb + vc); }
    weight[0] = 1 - v - w; weight[1] = v; weight[2] = w;
}

constexpr double FLAT = 1e-10;  // sine of a triangle's angle that is no more than rounding

// Unit normal of a triangle by the right-hand rule; false if it has no area.
HOST_DEVICE bool normal_of(const double* a, const double* b, const double* c, double* n) {
    const double u[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, v[3] = {c[0] - a[0], c[1] - a[1], c[2] - a[2]};
    n[0] = u[1] * v[2] - u[2] * v[1]; n[1] = u[2] * v[0] - u[0] * v[2]; n[2] = u[0] * v[1] - u[1] * v[0];
    return make_unit(n) > FLAT * sqrt(dot3(u, u) * dot3(v, v));
}

constexpr double DEEP = 5;  // thicknesses: a vertex further inside is not pushed out, since its nearest triangle may be on the other side

struct Touch {          // where a vertex may touch a triangle in a step
    double entry;       // part of the step at which it first comes nearer than the thickness; NEVER: it does not
    double distance;    // at the start of the step, negative inside [m]
    double certainty;   // how well the triangle's side tells inside from outside; of equally near triangles the largest counts
    double normal[3];   // out of the triangle's body
    double weight[3];   // of its corners, at the point touched
};

// Distance of p from the triangle; out: weights of its nearest point, and the way from there to p.
HOST_DEVICE double apart(const double* p, const double* a, const double* b, const double* c, double* weight, double* off) {
    nearest_on_triangle(p, a, b, c, weight);
    for (int k = 0; k < 3; ++k) off[k] = p[k] - (weight[0] * a[k] + weight[1] * b[k] + weight[2] * c[k]);
    return sqrt(dot3(off, off));
}

constexpr int MOST_STEPS = 40;  // of Newton's method towards a time of entry

// p: the vertex; path: its displacement in the step less that of the triangle. A vertex that is near, or inside, has the nearest
// point; one in front of the triangle that comes nearer than the thickness has the point where it does so, whatever its speed.
// False: neither, and further away than DEEP thicknesses. True with entry NEVER: it says on which side of the body the vertex is.
HOST_DEVICE bool meet(const double* p, const double* path, const double* a, const double* b, const double* c, double thickness, Touch& t) {
    double face[3], off[3], weight[3], there[3];
    if (!normal_of(a, b, c, face)) return false;
    const double away = apart(p, a, b, c, t.weight, off), side = dot3(face, off);
    t.certainty = away > 0 ? fabs(side) / away : 1;
    t.distance = side < 0 ? -away : away;
    t.entry = NEVER;
    const bool along_face = away < 1e-3 * thickness || side < 0;
    for (int k = 0; k < 3; ++k) t.normal[k] = along_face ? face[k] : off[k] / away;
    const double approach = dot3(t.normal, path);
    if (away <= (side < 0 ? DEEP : 1) * thickness) {
        if (approach < 0) t.entry = 0;
        return true;
    }
    if (side < 0) return false;
    // The distance along a straight path is convex, so steps of Newton's method never pass the entry.
    double when = 0, gap = away;
    for (int step = 0; step < MOST_STEPS; ++step) {
        const double slope = dot3(off, path) / gap;
        if (!(slope < 0)) break;
        when -= (gap - thickness) / slope;
        if (!(when <= 1)) break;
        for (int k = 0; k < 3; ++k) there[k] = p[k] + when * path[k];
        gap = apart(there, a, b, c, weight, off);
        if (gap > thickness * (1 + 1e-6)) continue;
        t.entry = when;
        for (int k = 0; k < 3; ++k) {
            t.normal[k] = off[k] / gap;
            t.weight[k] = weight[k];
        }
        return true;
    }
    return away <= DEEP * thickness;
}
