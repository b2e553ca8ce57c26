// SPDX-License-Identifier: MIT
// Rows of triangles of surfaces against obstacles (triangle_shape.cuh); shared by both devices. A triangle has one row, for the obstacle
// that it meets first between its corners; its least distance on an edge counts for the triangle that owns the edge, and near a corner for
// the corner's own rows.
#pragma once
#include "contact_passes.cuh"
#include "pair_detection.cuh"
#include "triangle_shape.cuh"

constexpr double ON_EDGE = 1e-9;      // a weight that is no more than rounding
constexpr double SAME_POINT = 0.25;   // difference of weights
constexpr int HOLDS = 10;             // rounds in which triangles are held back

struct FaceTables {           // of all bodies (backends/contact.py)
    ObstacleTable obstacles;
    int obstacle_count;
    const int* start;         // (bodies + 1,) rows
    const int* face;          // (faces, 3) nodes
    const int* owns;          // (faces,) bits
    const double* pair_friction;  // (bodies, obstacles)
    const int* node_site;     // (nodes,) or -1
    int* corner;              // (rows, CORNERS)
    double* weight;           // (rows, CORNERS)
    int* obstacle;            // (rows,)
    double *normal, *gap, *drift, *entry, *stiffness, *friction, *thickness, *hardening, *force, *traction;
};

HOST_DEVICE const int* nodes_of_face(const FaceTables& c, int row) { return c.face + 3 * (row - c.start[0]); }

// True if a point is on an edge that another triangle owns.
HOST_DEVICE bool is_anothers(const FaceTables& c, int row, const double* weight) {
    for (int a = 0; a < 3; ++a)
        if (weight[(a + 2) % 3] <= ON_EDGE && !(c.owns[row - c.start[0]] >> a & 1)) return true;
    return false;
}

// The site for which an obstacle without a row is counted; -1: all corners are fixed.
HOST_DEVICE int site_of_face(const FaceTables& c, int row) {
    for (int a = 0; a < 3; ++a)
        if (const int site = c.node_site[nodes_of_face(c, row)[a]]; site >= 0) return site;
    return -1;
}

// True if nothing in a sphere that moves, and changes its radius, comes nearer than `reach`: the paths of any two points differ by both
// radii at most. from, to: its middle at the start and the end of the step
HOST_DEVICE bool stays_far(const ObstacleTable& t, int obstacle, const double* from, double from_radius, const double* to, double to_radius,
                           double reach) {
    double begin[3], end[3], n[3];
    local_point(t.begin + 7 * obstacle, from, begin);
    local_point(t.end + 7 * obstacle, to, end);
    const double distance = distance_to(t, obstacle, begin, n);
    for (int m = 0; m < 3; ++m) end[m] -= begin[m];
    return distance > sqrt(dot3(end, end)) + 2 * from_radius + to_radius + reach;
}

// Middle of a box; returns its distance from the corners.
HOST_DEVICE double sphere_around(const Box& box, double* middle) {
    double half[3];
    for (int m = 0; m < 3; ++m) {
        middle[m] = 0.5 * (box.low[m] + box.high[m]);
        half[m] = 0.5 * (box.high[m] - box.low[m]);
    }
    return sqrt(dot3(half, half));
}

HOST_DEVICE void forget_face(const FaceTables& c, int row) {
    c.force[row] = 0;
    c.hardening[row] = 1;
    for (int m = 0; m < 3; ++m) c.traction[3 * row + m] = 0;
}

// Makes a row of where a triangle touches an obstacle. It has no forces. ways: of its corners past the obstacle
template <class Real>
HOST_DEVICE void put_face_row(const FaceTables& c, const Real* positions, int body, int row, const FaceTouch& t, const NodeWay* const* ways) {
    const int* node = nodes_of_face(c, row);
    double at[3] = {0, 0, 0}, begin[3] = {0, 0, 0}, end[3] = {0, 0, 0}, stiffness = 0, share = 0;
    for (int a = 0; a < 3; ++a) {
        const double w = t.held[a];
        const Real* x = positions + 3 * (long long)node[a];
        const NodeWay& by = *ways[a];
        c.corner[CORNERS * row + a] = node[a];
        c.weight[CORNERS * row + a] = w;
        for (int m = 0; m < 3; ++m) {
            at[m] += w * x[m];
            begin[m] += t.weight[a] * by.begin[m];
            end[m] += t.weight[a] * by.end[m];
        }
        const int site = c.node_site[node[a]];
        if (site < 0) continue;  // a fixed node has no stiffness
        stiffness += w * c.stiffness[2 * site];
        share += w;
    }
    c.corner[CORNERS * row + 3] = -1;
    c.obstacle[row] = t.obstacle;
    c.gap[row] = plane_on_way(c.obstacles, t.obstacle, at, begin, end, t.time, c.normal + 3 * row, c.drift + 3 * row);
    c.entry[row] = t.entry;
    c.stiffness[row] = share > 0 ? stiffness / share : 0;
    c.friction[row] = c.pair_friction[body * c.obstacle_count + t.obstacle];
    forget_face(c, row);
}

// Looks whether a triangle touches an obstacle before what it is known to touch first. True if one of the two has no row.
HOST_DEVICE bool consider_face(const FaceTables& c, int row, int obstacle, const NodeWay* const* ways, FaceTouch& first) {
    FaceTouch t = {-1, NEVER, 0, 0, {}, {}};
    if (c.obstacle[row] == obstacle && c.force[row] > 0)
        t = face_stays(c.obstacles, obstacle, ways, c.thickness[row], c.weight + CORNERS * row);
    if (t.obstacle < 0) {
        t = face_touch(c.obstacles, obstacle, ways, c.thickness[row]);
        if (t.obstacle < 0 || is_anothers(c, row, t.weight)) return false;
    }
    const bool two = first.obstacle >= 0;
    if (comes_before(t, first)) first = t;
    return two;
}

// Empties the row of a triangle that touches nothing.
HOST_DEVICE void empty_face_row(const FaceTables& c, int row) {
    if (c.obstacle[row] < 0) return;
    c.obstacle[row] = -1;
    c.entry[row] = NEVER;
    forget_face(c, row);
}

// Sets the row of a triangle that touches something; it remembers its forces if it touched the same.
template <class Real>
HOST_DEVICE void set_face_row(const FaceTables& c, const Real* x, int body, int row, const FaceTouch& t, const NodeWay* const* ways) {
    const RowMemory last = memory_of(c, row);
    put_face_row(c, x, body, row, t, ways);
    recall(c, row, &last, 1);
}

// Where a solution takes a triangle through an obstacle; obstacle -1: it does not. time: of the passage
HOST_DEVICE FaceTouch passage_of_face(const FaceTables& c, int row, int obstacle, const NodeWay* const* ways, double* time) {
    FaceTouch t = face_passage(c.obstacles, obstacle, ways, c.thickness[row], THROUGH * c.thickness[row], time);
    if (t.obstacle >= 0 && is_anothers(c, row, t.held)) t.obstacle = -1;
    return t;
}

// Gives a triangle that a solution takes into an obstacle a row there, or makes its row stiffer. False if the row holds another
// obstacle. carries: the row bears a force
template <class Real>
HOST_DEVICE bool take_face_row(const FaceTables& c, const Real* x, int body, int row, const FaceTouch& t, const NodeWay* const* ways, bool carries) {
    const bool same = c.obstacle[row] == t.obstacle;
    if (!same && c.obstacle[row] >= 0 && carries) return false;
    const double n[3] = {c.normal[3 * row], c.normal[3 * row + 1], c.normal[3 * row + 2]}, hardening = c.hardening[row];
    double moved = 0;
    for (int a = 0; a < 3; ++a) moved = fmax(moved, fabs(c.weight[CORNERS * row + a] - t.held[a]));
    put_face_row(c, x, body, row, t, ways);
    const bool harder = same && moved < SAME_POINT && dot3(n, c.normal + 3 * row) > SAME_PLANE;
    if (same) c.hardening[row] = harder ? fmin(hardening * HARDER, HARDEST) : hardening;
    return true;
}

// Where a node of a triangle that passes an obstacle is set back to, world frame. time: of the passage. count, from, entry: as of
// place_in_front
template <class Entry>
HOST_DEVICE void place_before(const ObstacleTable& t, int count, int obstacle, const NodeWay& way, double time, const double* from, double* back,
                              Entry entry) {
    for (int m = 0; m < 3; ++m) back[m] = way.begin[m] + SHORT_OF * time * (way.end[m] - way.begin[m]);
    world_point(t.end + 7 * obstacle, back, back);
    place_between(t, count, obstacle, from, back, entry);
}
