// SPDX-License-Identifier: MIT
// Where edges of two bodies touch each other, between their ends (edge_edge.cuh); shared by both devices. Vertices hold what lies flat, so
// only sharp edges count. The edges of the body with the finer surface have the rows, two each: for the edges that they meet first, or are
// nearest to. A row remembers its forces as long as the edges are the same.
#pragma once
#include "contact_passes.cuh"
#include "edge_edge.cuh"
#include "pair_detection.cuh"

struct EdgeTables {           // of all bodies (backends/contact.py), beside SurfaceTables
    const int* start;         // (bodies + 1,) rows, two for each edge
    const int* edge;          // (edges, 2) nodes, as the triangle that owns the edge has them
    const int* opposite;      // (edges, 2) third corners of its triangles
    const int* of_triangle;   // (triangles, 3) edges that a triangle owns; -1
    const double* length;     // (bodies,) of edges in the mean [m]
    EdgeWings* wings;         // (edges,) fitted with the trees
    int* facing;              // (rows from start[0] on,) the other edge
};

HOST_DEVICE int edge_of_row(const EdgeTables& e, int row) { return (row - e.start[0]) / 2; }
// True if rows between the bodies are those of `body`.
HOST_DEVICE bool has_rows(const EdgeTables& e, int body, int other) {
    return e.length[body] < e.length[other] || (e.length[body] == e.length[other] && body < other);
}

template <class Motion> HOST_DEVICE EdgePath path_of(const EdgeTables& e, const Motion& m, int edge) {
    EdgePath path;
    for (int end = 0; end < 2; ++end) {
        place_of(m, e.edge[2 * edge + end], path.x[end]);
        displacement_of(m, e.edge[2 * edge + end], path.way[end]);
    }
    return path;
}

template <class Motion> HOST_DEVICE void fit_wings(const EdgeTables& e, const Motion& m, int edge) {
    double p[4][3];
    for (int k = 0; k < 4; ++k) place_of(m, (k < 2 ? e.edge : e.opposite)[2 * edge + k % 2], p[k]);
    e.wings[edge] = wings_of(p[0], p[1], p[2], p[3]);
}

struct EdgeMeeting {
    int other, edge;     // body and edge; -1: none
    EdgeTouch touch;
};

HOST_DEVICE bool comes_before(const EdgeMeeting& a, const EdgeMeeting& b) {
    if (b.other < 0) return a.other >= 0;
    return a.other >= 0 && (a.touch.entry < b.touch.entry || (a.touch.entry == b.touch.entry && a.touch.distance < b.touch.distance));
}

// f(other body, its edge, thickness) of the sharp edges of bodies whose rows are those of this edge's body, and whose boxes meet its way.
template <class Motion, class F>
HOST_DEVICE void each_facing_edge(const SurfaceTables& c, const EdgeTables& e, const Motion& m, int body, int edge, F f) {
    if (!e.wings[edge].sharp) return;
    const int *node = e.edge + 2 * edge;
    for (int other = 0; other < c.bodies; ++other) {
        if (other == body || !(c.near[other] & 1) || !has_rows(e, body, other)) continue;
        const double thickness = 0.5 * (thickness_of(c, body) + thickness_of(c, other));
        const Box box = joined(box_of(m, node[0], thickness), box_of(m, node[1], thickness));
        if (!meet(box, c.body_box[other])) continue;
        int stack[64], depth = 0;
        stack[depth++] = c.tree_start[other];
        while (depth) {
            const int k = stack[--depth], left = c.tree_child[2 * k];
            if (!meet(c.tree_box[k], box)) continue;
            if (left >= 0) {
                stack[depth++] = left;
                stack[depth++] = c.tree_child[2 * k + 1];
                continue;
            }
            for (int a = 0; a < 3; ++a) {
                const int facing = e.of_triangle[3 * ~left + a];
                if (facing >= 0 && e.wings[facing].sharp) f(other, facing, thickness);
            }
        }
    }
}

// Stiffness of a point of an edge by those of its nodes; of a fixed one 0.
HOST_DEVICE double stiffness_at(const SurfaceTables& c, const int* node, double part) {
    double sum = 0, share = 0;
    for (int end = 0; end < 2; ++end) {
        const int site = c.node_site[node[end]];
        if (site < 0) continue;
        const double w = end ? part : 1 - part;
        sum += w * c.stiffness[2 * site];
        share += w;
    }
    return share > 0 ? sum / share : 0;
}

// Makes a row of where an edge touches another one; of none an empty one. It has no forces.
template <class Motion>
HOST_DEVICE void put_edge_row(const SurfaceTables& c, const EdgeTables& e, const Motion& m, int row, int body, const EdgeMeeting& t) {
    c.obstacle[row] = t.other;
    e.facing[row - e.start[0]] = t.edge;
    c.force[row] = 0;
    c.entry[row] = NEVER;
    c.hardening[row] = 1;
    for (int k = 0; k < 3; ++k) c.traction[3 * row + k] = 0;
    if (t.other < 0) return;
    const int *own = e.edge + 2 * edge_of_row(e, row), *facing = e.edge + 2 * t.edge;
    const double weight[4] = {1 - t.touch.s, t.touch.s, t.touch.t - 1, -t.touch.t};
    double gap = 0, *normal = c.normal + 3 * row;
    for (int a = 0; a < CORNERS; ++a) {
        const int node = a < 2 ? own[a] : facing[a - 2];
        c.corner[CORNERS * row + a] = node;
        c.weight[CORNERS * row + a] = weight[a];
        for (int k = 0; k < 3; ++k) gap += t.touch.normal[k] * weight[a] * (double)m.x[3 * (long long)node + k];
    }
    for (int k = 0; k < 3; ++k) normal[k] = t.touch.normal[k];
    const double ours = stiffness_at(c, own, t.touch.s), theirs = stiffness_at(c, facing, t.touch.t);
    c.gap[row] = gap;
    c.entry[row] = t.touch.entry;
    c.stiffness[row] = ours > 0 && theirs > 0 ? 2 * ours * theirs / (ours + theirs) : ours + theirs;  // a fixed edge has none
    c.friction[row] = c.pair_friction[body * c.bodies + t.other];
    c.thickness[row] = 0.5 * (thickness_of(c, body) + thickness_of(c, t.other));
}

// Normal of the row of an edge that another one bore on in the last step; null: there is none.
HOST_DEVICE const double* held_by(const SurfaceTables& c, const EdgeTables& e, int edge, int other, int facing) {
    for (int row = e.start[0] + 2 * edge, r = row; r < row + 2; ++r)
        if (c.obstacle[r] == other && e.facing[r - e.start[0]] == facing && c.force[r] > 0) return c.normal + 3 * r;
    return nullptr;
}

struct EdgeMeetings {    // of an edge: the two that come first, and how many more it comes near to
    EdgeMeeting first, second;
    int left;
};
HOST_DEVICE EdgeMeetings no_edges() { return {{-1, -1, {}}, {-1, -1, {}}, 0}; }

HOST_DEVICE void take(EdgeMeetings& found, EdgeMeeting here) {
    if (comes_before(here, found.first)) {
        const EdgeMeeting last = found.first;
        found.first = here;
        here = last;
    }
    if (comes_before(here, found.second)) {
        const EdgeMeeting last = found.second;
        found.second = here;
        here = last;
    }
    found.left += here.other >= 0 && here.touch.entry <= 1;
}

// Sets both rows of an edge; returns how many more edges it comes near to. found: those of its own body
template <class Motion>
HOST_DEVICE int detect_edge(const SurfaceTables& c, const EdgeTables& e, const Motion& m, int body, int edge, EdgeMeetings found) {
    const int row = e.start[0] + 2 * edge;
    const EdgePath path = path_of(e, m, edge);
    each_facing_edge(c, e, m, body, edge, [&](int other, int facing, double thickness) {
        EdgeMeeting here = {other, facing, {}};
        const double* held = held_by(c, e, edge, other, facing);
        if (!meet_edges(path, e.wings[edge], path_of(e, m, facing), e.wings[facing], thickness, 1e-2 * thickness, held, here.touch)) return;
        take(found, here);
    });
    const EdgeMeeting &first = found.first, &second = found.second;
    if (first.other < 0 && c.obstacle[row] < 0 && c.obstacle[row + 1] < 0) return 0;  // the rows are empty already
    const RowMemory last[2] = {memory_of(c, row), memory_of(c, row + 1)};
    const int facing[2] = {e.facing[row - e.start[0]], e.facing[row + 1 - e.start[0]]};
    for (int slot = 0; slot < 2; ++slot) {
        const EdgeMeeting& t = slot ? second : first;
        put_edge_row(c, e, m, row + slot, body, t);
        for (int r = 0; r < 2; ++r)
            if (t.other >= 0 && facing[r] == t.edge) recall(c, row + slot, last + r, 1);
    }
    return found.left;
}

// The site for which edges without a row are counted; -1: both ends are fixed.
HOST_DEVICE int site_of_edge(const SurfaceTables& c, const EdgeTables& e, int edge) {
    for (int end = 0; end < 2; ++end)
        if (const int site = c.node_site[e.edge[2 * edge + end]]; site >= 0) return site;
    return -1;
}

// --- what a solution does -----------------------------------------------------------------------------------------------------------

// f(other, facing, thickness, touch) of the edges that a solution takes an edge through.
template <class Motion, class F>
HOST_DEVICE void each_edge_passed(const SurfaceTables& c, const EdgeTables& e, const Motion& m, int body, int edge, F f) {
    each_facing_edge(c, e, m, body, edge, [&](int other, int facing, double thickness) {
        const EdgePath path = path_of(e, m, edge), way = path_of(e, m, facing);
        EdgeTouch t;
        if (!edges_pass(path, e.wings[edge], way, e.wings[facing], THROUGH * thickness)) return;
        if (meet_edges(path, e.wings[edge], way, e.wings[facing], thickness, 1e-2 * thickness, nullptr, t)) f(other, facing, thickness, t);
    });
}

// Gives an edge that another one passes one of its rows: the other's own, an empty one, or the one that carries less; -1: it is made
// stiffer. force_of(row): normal force
template <class Motion, class F>
HOST_DEVICE int take_edge_row(const SurfaceTables& c, const EdgeTables& e, const Motion& m, int body, int edge, const EdgeMeeting& t, F force_of) {
    const int row = e.start[0] + 2 * edge, *facing = e.facing + 2 * edge;
    int k = row;
    if (facing[0] != t.edge || c.obstacle[row] < 0) {
        const bool next = c.obstacle[row + 1] < 0 || facing[1] == t.edge;
        k += next || (c.obstacle[row] >= 0 && force_of(row + 1) < force_of(row));
    }
    const bool same = c.obstacle[k] >= 0 && facing[k - row] == t.edge;
    if (same && dot3(c.normal + 3 * k, t.touch.normal) > SAME_PLANE) {
        c.hardening[k] = fmin(HARDER * c.hardening[k], HARDEST);
        return -1;
    }
    put_edge_row(c, e, m, k, body, t);
    return k;
}
