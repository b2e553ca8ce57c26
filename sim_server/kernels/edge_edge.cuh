// SPDX-License-Identifier: MIT
// Two edges of surfaces: their nearest points, and when their paths meet; shared by both devices.
#pragma once
#include "shapes.cuh"

// Parts s, t of the segments p1 -> q1 and p2 -> q2 at which they are nearest (Ericson, Real-Time Collision Detection, 2005,
// section 5.1.9). Returns their distance.
HOST_DEVICE double nearest_on_segments(const double* p1, const double* q1, const double* p2, const double* q2, double* s, double* t) {
    double d1[3], d2[3], r[3], off[3];
    for (int k = 0; k < 3; ++k) {
        d1[k] = q1[k] - p1[k];
        d2[k] = q2[k] - p2[k];
        r[k] = p1[k] - p2[k];
    }
    const double a = dot3(d1, d1), e = dot3(d2, d2), f = dot3(d2, r), c = dot3(d1, r), b = dot3(d1, d2), area = a * e - b * b;
    auto within = [](double v) { return v < 0 ? 0.0 : v > 1 ? 1.0 : v; };
    *s = area > 1e-14 * a * e ? within((b * f - c * e) / area) : 0;
    *t = e > 0 ? (b * *s + f) / e : 0;
    if (!(e > 0) || *t < 0 || *t > 1) {
        *t = within(*t);
        *s = a > 0 ? within((b * *t - c) / a) : 0;
    }
    for (int k = 0; k < 3; ++k) off[k] = r[k] + *s * d1[k] - *t * d2[k];
    return sqrt(dot3(off, off));
}

// --- edges of surfaces --------------------------------------------------------------------------------------------------------------

constexpr double PARALLEL = 1e-3;      // sine of an angle between edges
constexpr double FLAT_EDGE = 0.05;     // sine of an angle by which both triangles of an edge must lean away from what it touches
constexpr double EDGE_DEEP = 2;        // thicknesses: edges that have crossed deeper are left to vertices

struct EdgeWings {           // of an edge: directions from it into its two triangles
    double into[2][3];
    int sharp;               // 1: the surface is convex there
};

// p -> q: the edge as the first of its triangles has it. r, r2: the third corners of both.
HOST_DEVICE EdgeWings wings_of(const double* p, const double* q, const double* r, const double* r2) {
    EdgeWings w;
    double e[3], n[3];
    for (int k = 0; k < 3; ++k) e[k] = q[k] - p[k];
    const bool has_length = make_unit(e) > 0;
    for (int side = 0; side < 2; ++side) {
        double* into = w.into[side];
        for (int k = 0; k < 3; ++k) into[k] = (side ? r2 : r)[k] - p[k];
        const double along = dot3(into, e);
        for (int k = 0; k < 3; ++k) into[k] -= along * e[k];
        make_unit(into);
    }
    for (int k = 0; k < 3; ++k) {  // normals e x into and into2 x e
        const int a = (k + 1) % 3, b = (k + 2) % 3;
        n[k] = e[a] * (w.into[0][b] - w.into[1][b]) - e[b] * (w.into[0][a] - w.into[1][a]);
    }
    const double both[3] = {w.into[0][0] + w.into[1][0], w.into[0][1] + w.into[1][1], w.into[0][2] + w.into[1][2]};
    w.sharp = has_length && dot3(both, n) < 0 && dot3(both, both) > 4 * FLAT_EDGE * FLAT_EDGE;
    return w;
}

// True if both triangles lean away by `least` from what is on the other side of a plane with normal n through the edge.
HOST_DEVICE bool leans(const EdgeWings& w, const double* n, double sign, double least) {
    return sign * dot3(w.into[0], n) > least && sign * dot3(w.into[1], n) > least;
}

struct EdgeTouch {       // where two edges may touch in a step
    double entry;        // part of the step at which they come nearer than the thickness; NEVER
    double distance;     // at the start of the step, negative once they have crossed [m]
    double normal[3];    // from the second to the first
    double s, t;         // parts of the first and the second one
};

struct EdgePath {        // corners at the start of the step, and their displacements
    double x[2][3], way[2][3];
};

HOST_DEVICE bool within_edge(double part) { return part > 1e-6 && part < 1 - 1e-6; }

HOST_DEVICE double edges_apart(const EdgePath& a, const EdgePath& b, double time, EdgeTouch& touch) {
    double p[4][3], off[3];
    for (int k = 0; k < 3; ++k)
        for (int end = 0; end < 2; ++end) {
            p[end][k] = a.x[end][k] + time * a.way[end][k];
            p[2 + end][k] = b.x[end][k] + time * b.way[end][k];
        }
    const double distance = nearest_on_segments(p[0], p[1], p[2], p[3], &touch.s, &touch.t);
    for (int k = 0; k < 3; ++k)
        off[k] = p[0][k] + touch.s * (p[1][k] - p[0][k]) - p[2][k] - touch.t * (p[3][k] - p[2][k]);
    for (int k = 0; k < 3; ++k) touch.normal[k] = distance > 0 ? off[k] / distance : 0;
    return distance;
}

// First time in [0, 1] at which edges farther apart than `inflate` come so near, to `slack`; NEVER. Each advance is what the fastest
// corners allow (additive advancement: Li, Kaufman and Jiang, Codimensional Incremental Potential Contact, 2021).
HOST_DEVICE double entry_of_edges(const EdgePath& a, const EdgePath& b, double inflate, double slack, EdgeTouch& touch) {
    double most = 0;
    for (int i = 0; i < 2; ++i) {
        double fastest = 0;
        for (int end = 0; end < 2; ++end) {
            double own[3];
            for (int k = 0; k < 3; ++k)
                own[k] = (i ? b : a).way[end][k] - 0.25 * (a.way[0][k] + a.way[1][k] + b.way[0][k] + b.way[1][k]);
            fastest = fmax(fastest, sqrt(dot3(own, own)));
        }
        most += fastest;
    }
    double time = 0;
    for (int trial = 0; trial < 200; ++trial) {
        const double left = edges_apart(a, b, time, touch) - inflate;
        if (left <= slack) return time;
        if (!(left < (1 - time) * most)) return NEVER;
        time += left / most;
    }
    return NEVER;
}

// Where two sharp edges touch between their ends, so that neither has a nearer point on its triangles. False: nowhere.
// held: normal with which they bore each other in the last step, null: they did not. Their triangles may then lean a little the other way:
// edges that bear each other turn to and fro about FLAT_EDGE, and would else spring in and out for ever.
HOST_DEVICE bool meet_edges(const EdgePath& a, const EdgeWings& wa, const EdgePath& b, const EdgeWings& wb, double thickness, double slack,
                            const double* held, EdgeTouch& touch) {
    double u[3], v[3], n[3], off[3];
    for (int k = 0; k < 3; ++k) {
        u[k] = a.x[1][k] - a.x[0][k];
        v[k] = b.x[1][k] - b.x[0][k];
        off[k] = a.x[0][k] - b.x[0][k];
    }
    for (int k = 0; k < 3; ++k) n[k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
    const double sine = make_unit(n);
    if (!(sine > PARALLEL * sqrt(dot3(u, u) * dot3(v, v)))) return false;
    if (dot3(held ? held : wa.into[0], n) < 0)
        for (int k = 0; k < 3; ++k) n[k] = -n[k];
    const double least = held ? -FLAT_EDGE : FLAT_EDGE;
    if (!leans(wa, n, 1, least) || !leans(wb, n, -1, least)) return false;
    const double gap = dot3(n, off), apart = edges_apart(a, b, 0, touch);
    const bool between = within_edge(touch.s) && within_edge(touch.t);
    touch.entry = NEVER;
    touch.distance = gap < 0 ? gap : apart;
    if (gap < 0 || apart <= thickness) {
        if (!between || gap < -EDGE_DEEP * thickness) return false;
        double rate = 0;
        for (int k = 0; k < 3; ++k) {
            touch.normal[k] = n[k];
            rate += n[k] * (a.way[0][k] + touch.s * (a.way[1][k] - a.way[0][k]) - b.way[0][k] - touch.t * (b.way[1][k] - b.way[0][k]));
        }
        if (rate < 0) touch.entry = 0;
        return true;
    }
    EdgeTouch then;
    const double time = entry_of_edges(a, b, thickness, slack, then);
    if (time <= 1 && within_edge(then.s) && within_edge(then.t) && leans(wa, then.normal, 1, FLAT_EDGE) && leans(wb, then.normal, -1, FLAT_EDGE)) {
        then.entry = time;
        then.distance = apart;
        touch = then;
        return true;
    }
    for (int k = 0; k < 3; ++k) touch.normal[k] = n[k];
    return time > 1 && between && apart < 2 * thickness;
}

// Whether the paths of two sharp edges that had not crossed pass through each other.
HOST_DEVICE bool edges_pass(const EdgePath& a, const EdgeWings& wa, const EdgePath& b, const EdgeWings& wb, double through) {
    EdgeTouch touch;
    if (!meet_edges(a, wa, b, wb, through, through, nullptr, touch) || !(touch.distance > 0)) return false;
    return touch.entry <= 1;
}
