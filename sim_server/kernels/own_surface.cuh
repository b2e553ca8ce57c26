// SPDX-License-Identifier: MIT
// Where the surface of a body touches itself: vertices against its own triangles, edges against its own edges, but for those nearby.
// Unlike against another body there is no inside to come to: what is behind a triangle is as a rule the other side of the same material.
// So the side is that from which a vertex comes along its path, which is followed exactly, with that of each corner.
#pragma once
#include "edge_detection.cuh"

constexpr int MAY_TOUCH_ITSELF = 2;  // bit of SurfaceTables::near

struct OwnTables {           // what does not touch each other (backends/contact.py)
    const int *start, *node; // (nodes + 1,), of each node of a surface those near it and itself, ascending; null: bodies do not touch themselves
};

HOST_DEVICE bool is_nearby(const OwnTables& o, int a, int b) {
    int low = o.start[a], high = o.start[a + 1];
    while (low < high) {
        const int middle = (low + high) / 2;
        if (o.node[middle] == b) return true;
        if (o.node[middle] < b) low = middle + 1;
        else high = middle;
    }
    return false;
}
HOST_DEVICE bool is_nearby_triangle(const OwnTables& o, int node, const int* corner) {
    return is_nearby(o, node, corner[0]) || is_nearby(o, node, corner[1]) || is_nearby(o, node, corner[2]);
}
HOST_DEVICE bool are_nearby_edges(const OwnTables& o, const int* a, const int* b) {
    return is_nearby(o, a[0], b[0]) || is_nearby(o, a[0], b[1]) || is_nearby(o, a[1], b[0]) || is_nearby(o, a[1], b[1]);
}

// --- a vertex and a triangle ----------------------------------------------------------------------------------------------------------

struct OwnPaths {            // of a vertex and the corners of a triangle: places at the start of the step, and displacements
    double x[4][3], way[4][3];
};

struct OwnPlace {            // of a vertex beside a triangle
    double distance, weight[3], off[3];  // off: from the nearest point to the vertex
    double side;             // above 0: in front
};

HOST_DEVICE OwnPlace place_at(const OwnPaths& p, double time) {
    OwnPlace t;
    double x[4][3], face[3];
    for (int a = 0; a < 4; ++a)
        for (int k = 0; k < 3; ++k) x[a][k] = p.x[a][k] + time * p.way[a][k];
    t.distance = apart(x[0], x[1], x[2], x[3], t.weight, t.off);
    t.side = normal_of(x[1], x[2], x[3], face) ? dot3(face, t.off) : 0;
    return t;
}

constexpr int MOST_OWN_ADVANCES = 100;

// First time in [0, 1] at which a vertex farther away than `inflate` comes so near; NEVER. With the triangle moved along as a whole the distance
// is convex in time, so its slope bounds it from below; the corners' own displacements are taken off that.
HOST_DEVICE double entry_of_vertex(const OwnPaths& p, double inflate, OwnPlace& t) {
    double path[3], own = 0, time = 0;
    for (int k = 0; k < 3; ++k) path[k] = p.way[0][k] - (p.way[1][k] + p.way[2][k] + p.way[3][k]) / 3;
    for (int a = 1; a < 4; ++a) {
        double d[3];
        for (int k = 0; k < 3; ++k) d[k] = p.way[a][k] - p.way[0][k] + path[k];
        own = fmax(own, sqrt(dot3(d, d)));
    }
    for (int trial = 0; trial < MOST_OWN_ADVANCES; ++trial) {
        t = place_at(p, time);
        const double left = t.distance - inflate;
        if (left <= 1e-2 * inflate) return time;
        const double rate = own - dot3(t.off, path) / t.distance;
        if (!(left < (1 - time) * rate)) return NEVER;
        time += left / rate;
    }
    return time;
}

// As `meet` of vertex_triangle.cuh. A vertex behind the triangle counts if it is over it, and no deeper than the thickness.
HOST_DEVICE bool meet_own(const OwnPaths& p, double thickness, Touch& t) {
    double face[3];
    t.distance = 0;
    if (!normal_of(p.x[1], p.x[2], p.x[3], face)) return false;
    const OwnPlace start = place_at(p, 0);
    const double away = start.distance;
    const bool behind = start.side < 0;
    t.certainty = away > 0 ? fabs(start.side) / away : 1;
    t.distance = behind ? -away : away;
    t.entry = NEVER;
    for (int k = 0; k < 3; ++k) {
        t.weight[k] = start.weight[k];
        t.normal[k] = behind || away < 1e-3 * thickness ? face[k] : start.off[k] / away;
    }
    if (away <= thickness) {
        double approach = 0;
        for (int a = 0; a < 4; ++a) approach += (a ? -t.weight[a - 1] : 1) * dot3(t.normal, p.way[a]);
        if (approach < 0) t.entry = 0;
        return !behind || t.certainty > OVER_FACE;
    }
    OwnPlace then;
    const double time = entry_of_vertex(p, thickness, then);
    if (time > 1 || !(then.side > 0)) return !behind && away <= 2 * thickness;
    t.entry = time;
    t.distance = away;
    for (int k = 0; k < 3; ++k) {
        t.normal[k] = then.off[k] / then.distance;
        t.weight[k] = then.weight[k];
    }
    return true;
}

template <class Motion> HOST_DEVICE OwnPaths own_paths(const SurfaceTables& c, const Motion& m, int node, int triangle) {
    OwnPaths p;
    for (int a = 0; a < 4; ++a) {
        const int corner = a ? c.triangle[3 * triangle + a - 1] : node;
        place_of(m, corner, p.x[a]);
        displacement_of(m, corner, p.way[a]);
    }
    return p;
}

// f(triangle) of those of the body whose boxes meet `box`
template <class F> HOST_DEVICE void each_own_triangle(const SurfaceTables& c, int body, const Box& box, F f) {
    int stack[64], depth = 0;
    stack[depth++] = c.tree_start[body];
    while (depth) {
        const int k = stack[--depth], left = c.tree_child[2 * k];
        if (!meet(c.tree_box[k], box)) continue;
        if (left < 0) { f(~left); continue; }
        stack[depth++] = left;
        stack[depth++] = c.tree_child[2 * k + 1];
    }
}

template <class Motion> HOST_DEVICE TouchSearch<Motion> own_search_of(const Motion& m, int node, double thickness) {
    return {&m, thickness, {}, {}, box_of(m, node, thickness), {-1, -1, {}}, {-1, -1, {}}, {-1, -1, {}}};
}

// As `consider` of pair_detection.cuh. least: of the distances at the start of the step, if that is less; null: not wanted
template <class Motion>
HOST_DEVICE void consider_own(const SurfaceTables& c, const OwnTables& o, const Motion& m, int body, int node, int triangle,
                              TouchSearch<Motion>& search, double* least) {
    if (is_nearby_triangle(o, node, c.triangle + 3 * triangle)) return;
    const double thickness = search.thickness;
    Meeting here = {body, triangle, {}}, &nearest = search.nearest;
    const bool met = meet_own(own_paths(c, m, node, triangle), thickness, here.touch);
    if (least) *least = fmin(*least, fabs(here.touch.distance));
    if (!met) return;
    const double farther = fabs(here.touch.distance) - fabs(nearest.touch.distance);
    const bool as_near = fabs(farther) <= 1e-9 * thickness;
    Meeting later = here;
    if (nearest.other < 0 || (as_near ? here.touch.certainty > nearest.touch.certainty : farther < 0)) {
        later = nearest;
        nearest = here;
    }
    if (is_over(later, thickness) && (search.beside.other < 0 || later.touch.distance < search.beside.touch.distance)) search.beside = later;
    if (here.touch.distance > 0 && here.touch.entry <= 1 && comes_before(here, search.first)) search.first = here;
}

// Searches the body of a vertex, which it touches at one thickness; `meet_own` tells how. least: as above
template <class Motion>
HOST_DEVICE TouchSearch<Motion> search_own(const SurfaceTables& c, const OwnTables& o, const Motion& m, int body, int node, double thickness,
                                           double* least = nullptr) {
    TouchSearch<Motion> search = own_search_of(m, node, thickness);
    each_own_triangle(c, body, search.box, [&](int triangle) { consider_own(c, o, m, body, node, triangle, search, least); });
    return search;
}

// True if a solution takes a vertex through a triangle of its own body. found: where it touches then.
template <class Motion>
HOST_DEVICE bool passes_own(const SurfaceTables& c, const OwnTables& o, const Motion& m, int body, int node, double thickness, Meeting& found) {
    const TouchSearch<Motion> through = search_own(c, o, m, body, node, THROUGH * thickness);
    if (!(found_by(through).other >= 0 && found_by(through).touch.entry <= 1)) return false;
    found = found_by(search_own(c, o, m, body, node, thickness));
    return found.other >= 0;
}

// --- edges ------------------------------------------------------------------------------------------------------------------------------

// As `meet_edges` of edge_edge.cuh, but the side is that on which the edges are. Rims of a strip that lies on itself count, whose triangles
// lean neither way. held: normal with which the edges bore each other in the last step, null: they did not.
HOST_DEVICE bool meet_own_edges(const EdgePath& a, const EdgeWings& wa, const EdgePath& b, const EdgeWings& wb, double thickness,
                                const double* held, EdgeTouch& touch) {
    double u[3], v[3], n[3];
    for (int k = 0; k < 3; ++k) {
        u[k] = a.x[1][k] - a.x[0][k];
        v[k] = b.x[1][k] - b.x[0][k];
    }
    for (int k = 0; k < 3; ++k) n[k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
    if (!(make_unit(n) > PARALLEL * sqrt(dot3(u, u) * dot3(v, v)))) return false;
    touch.distance = edges_apart(a, b, 0, touch);
    touch.entry = NEVER;
    const bool between = within_edge(touch.s) && within_edge(touch.t);
    auto leans_away = [&](const double* normal) { return leans(wa, normal, 1, -FLAT_EDGE) && leans(wb, normal, -1, -FLAT_EDGE); };
    if (between) {  // the nearest points lie along the common normal
        if (dot3(n, held ? held : touch.normal) < 0)
            for (int k = 0; k < 3; ++k) n[k] = -n[k];
        if (dot3(n, touch.normal) < 0) touch.distance = -touch.distance;
        for (int k = 0; k < 3; ++k) touch.normal[k] = n[k];
    }
    if (touch.distance <= thickness) {
        if (!between || touch.distance < -thickness || (!held && !leans_away(n))) return false;
        double rate = 0;
        for (int k = 0; k < 3; ++k)
            rate += n[k] * (a.way[0][k] + touch.s * (a.way[1][k] - a.way[0][k]) - b.way[0][k] - touch.t * (b.way[1][k] - b.way[0][k]));
        if (rate < 0) touch.entry = 0;
        return true;
    }
    EdgeTouch then;
    const double time = entry_of_edges(a, b, thickness, 1e-2 * thickness, then);
    if (time <= 1 && within_edge(then.s) && within_edge(then.t) && leans_away(then.normal)) {
        then.entry = time;
        then.distance = touch.distance;
        touch = then;
        return true;
    }
    return time > 1 && between && touch.distance < 2 * thickness && leans_away(touch.normal);
}

// True if the paths of two edges, whatever their triangles, take them through each other. touch: where they touch then.
HOST_DEVICE bool own_edges_pass(const EdgePath& a, const EdgePath& b, double thickness, EdgeTouch& touch) {
    EdgeTouch then;
    const double through = THROUGH * thickness;
    if (!(edges_apart(a, b, 0, touch) > through) || !(entry_of_edges(a, b, through, through, then) <= 1)) return false;
    if (!within_edge(then.s) || !within_edge(then.t)) return false;  // vertices pass triangles there
    touch.distance = edges_apart(a, b, 0, touch);
    touch.entry = touch.distance > thickness ? entry_of_edges(a, b, thickness, 1e-2 * thickness, touch) : 0;
    return touch.entry <= 1;
}

// f(other edge) of those of the same body that come before this one, are not nearby, and may meet its way.
template <class Motion, class F>
HOST_DEVICE void each_own_edge(const SurfaceTables& c, const EdgeTables& e, const OwnTables& o, const Motion& m, int body, int edge, F f) {
    const int* node = e.edge + 2 * edge;
    const double thickness = thickness_of(c, body);
    each_own_triangle(c, body, joined(box_of(m, node[0], thickness), box_of(m, node[1], thickness)), [&](int triangle) {
        const int *number = e.of_triangle + 3 * triangle, *corner = c.triangle + 3 * triangle;
        auto counts = [&](int a) { return number[a] >= 0 && number[a] < edge; };
        if (!counts(0) && !counts(1) && !counts(2)) return;
        bool nearby[3];
        for (int a = 0; a < 3; ++a) nearby[a] = is_nearby(o, node[0], corner[a]) || is_nearby(o, node[1], corner[a]);
        for (int a = 0; a < 3; ++a)
            if (counts(a) && !nearby[a] && !nearby[(a + 1) % 3]) f(number[a]);
    });
}

// f(meeting) of the edges of the same body that an edge may touch in the step: of sharp ones, and of those that it bore on in the last step.
// least: of the distances at the start of the step, if that is less; null: not wanted
template <class Motion, class F>
HOST_DEVICE void meet_each_own_edge(const SurfaceTables& c, const EdgeTables& e, const OwnTables& o, const Motion& m, int body, int edge,
                                    double* least, F f) {
    const EdgePath path = path_of(e, m, edge);
    each_own_edge(c, e, o, m, body, edge, [&](int facing) {
        EdgeTouch start;
        const EdgePath way = path_of(e, m, facing);
        if (least) *least = fmin(*least, edges_apart(path, way, 0, start));
        const double* held = held_by(c, e, edge, body, facing);
        if (!held && !(e.wings[edge].sharp && e.wings[facing].sharp)) return;
        EdgeMeeting here = {body, facing, {}};
        if (meet_own_edges(path, e.wings[edge], way, e.wings[facing], thickness_of(c, body), held, here.touch)) f(here);
    });
}

// f(facing, touch) of the edges of the same body that a solution takes an edge through.
template <class Motion, class F>
HOST_DEVICE void each_own_edge_passed(const SurfaceTables& c, const EdgeTables& e, const OwnTables& o, const Motion& m, int body, int edge, F f) {
    const EdgePath path = path_of(e, m, edge);
    each_own_edge(c, e, o, m, body, edge, [&](int facing) {
        EdgeTouch t;
        if (own_edges_pass(path, path_of(e, m, facing), thickness_of(c, body), t)) f(facing, t);
    });
}
