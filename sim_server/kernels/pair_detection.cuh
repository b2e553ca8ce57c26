// SPDX-License-Identifier: MIT
// Where the surfaces of bodies touch each other: each vertex against the triangles of the other bodies, along the paths that gravity
// alone would make, or that a solution makes (vertex_triangle.cuh); shared by both devices. A vertex has two rows, for the two bodies that
// it meets first, or is nearest to, or for both sides of a crease of one; a row remembers its forces as long as the vertex touches the same
// body, on whichever triangle.
//
// A body has a tree of boxes over its triangles, made once, whose boxes are fitted anew in each step in which its own box meets
// another's. Children come after their parents.
#pragma once
#include "boxes.cuh"
#include "contact_law.cuh"
#include "vertex_triangle.cuh"

constexpr double THROUGH = 1e-3;  // thicknesses: a vertex whose path comes so near passes the triangle
constexpr double CREASE = 0.9;    // cosine of the angle between two triangles that a vertex lies on as in a crease, or less
constexpr double OVER_FACE = 0.999;    // of a triangle's certainty: the vertex is over it, not beyond its edges
constexpr double INSIDE = 3;      // thicknesses over DEEP: how deep a vertex may have come in one step to be sent back

// How nodes move in a step. Real, Local: types of the state and of rotations.
template <class Real, class Local> struct SurfaceMotion {
    const Real* x;            // (nodes, 3) positions at the start
    const Real* predictor;    // (nodes, 3) [m/s]; null: nothing moves
    const Real* y;            // (nodes, 3) solution found, material frame; null: before the solve, under gravity alone
    const Local* rotation;    // (nodes, 3, 3)
    const Real* free;         // (nodes,) 0: the node is fixed
    double dx_dv, force_coefficient;  // [s]
    const double* gravity;    // (3,) [m/s2]
};

struct SurfaceTables {        // of all bodies (backends/contact.py)
    int bodies;
    const int* body_start;    // (bodies + 1,) rows against obstacles, two for each site: a node of a surface
    int* corner;              // (rows, CORNERS)
    double* weight;           // (rows, CORNERS)
    int* obstacle;            // (rows,) of a row between bodies: the other body
    double *normal, *gap, *entry, *stiffness, *friction, *thickness, *hardening, *force, *traction;
    int pair_first;           // row of the first one between bodies
    const int *site_body, *node_site;        // (sites,), (nodes,) or -1
    const int* triangle;                     // (triangles, 3) nodes
    const int *tree_start, *tree_child;      // (bodies + 1,), (tree, 2): two children, or ~ of a triangle, twice
    Box *tree_box, *body_box;                // (tree,), (bodies,)
    const int* near;                         // (bodies,) 1: its box meets another's; 2: it may touch itself; then its tree is fitted
    const double* pair_friction;             // (bodies, bodies)
    const double* body_thickness;            // (bodies,)
};

HOST_DEVICE int sites_before(const SurfaceTables& c, int body) { return c.body_start[body] / 2; }
HOST_DEVICE int node_of_site(const SurfaceTables& c, int site) { return c.corner[CORNERS * 2 * site]; }
HOST_DEVICE double thickness_of(const SurfaceTables& c, int body) { return c.body_thickness[body]; }

// --- motion and boxes ---------------------------------------------------------------------------------------------------------------

template <class Real, class Local> HOST_DEVICE void place_of(const SurfaceMotion<Real, Local>& m, int node, double* x) {
    for (int k = 0; k < 3; ++k) x[k] = m.x[3 * (long long)node + k];
}

// Displacement of a node in the step.
template <class Real, class Local> HOST_DEVICE void displacement_of(const SurfaceMotion<Real, Local>& m, int node, double* s) {
    const long long at = 3 * (long long)node;
    for (int k = 0; k < 3; ++k) s[k] = 0;
    if (!m.predictor) return;
    if (m.y) {
        const Local* R = m.rotation + 3 * at;
        const Real* y = m.y + at;
        for (int k = 0; k < 3; ++k) {
            const double u = (double)R[3 * k] * y[0] + (double)R[3 * k + 1] * y[1] + (double)R[3 * k + 2] * y[2];
            s[k] = m.dx_dv * (m.predictor[at + k] + u);
        }
        return;
    }
    for (int k = 0; k < 3; ++k) {
        const double g = m.free[node] == 0 ? 0 : m.force_coefficient * m.gravity[k];
        s[k] = m.dx_dv * (m.predictor[at + k] + g);
    }
}

// Around a node's way.
template <class Motion> HOST_DEVICE Box box_of(const Motion& m, int node, double margin) {
    Box box = empty_box();
    double x[3], s[3], end[3];
    place_of(m, node, x);
    displacement_of(m, node, s);
    for (int k = 0; k < 3; ++k) end[k] = x[k] + s[k];
    include(box, x, margin);
    include(box, end, margin);
    return box;
}

template <class Motion> HOST_DEVICE void fit_body(const SurfaceTables& c, const Motion& m, int body) {
    Box box = empty_box();
    const double margin = thickness_of(c, body);
    for (int site = sites_before(c, body); site < sites_before(c, body + 1); ++site) box = joined(box, box_of(m, node_of_site(c, site), margin));
    for (int k = c.tree_start[body]; k < c.tree_start[body + 1]; ++k)
        for (int a = 0; a < 3 && c.tree_child[2 * k] < 0; ++a) {
            const int node = c.triangle[3 * ~c.tree_child[2 * k] + a];
            if (c.node_site[node] < 0) box = joined(box, box_of(m, node, margin));  // a fixed node
        }
    c.body_box[body] = box;
}

// Box k of a body's tree, once its children have theirs.
template <class Motion> HOST_DEVICE void fit_box(const SurfaceTables& c, const Motion& m, int body, int k) {
    const int left = c.tree_child[2 * k], right = c.tree_child[2 * k + 1];
    if (left >= 0) {
        c.tree_box[k] = joined(c.tree_box[left], c.tree_box[right]);
        return;
    }
    Box box = empty_box();
    for (int a = 0; a < 3; ++a) box = joined(box, box_of(m, c.triangle[3 * ~left + a], thickness_of(c, body)));
    c.tree_box[k] = box;
}
template <class Motion> HOST_DEVICE void fit_tree(const SurfaceTables& c, const Motion& m, int body) {
    for (int k = c.tree_start[body + 1] - 1; k >= c.tree_start[body]; --k) fit_box(c, m, body, k);
}

// --- search -------------------------------------------------------------------------------------------------------------------------

struct Meeting {
    int other;           // body; -1: none
    int triangle;
    Touch touch;
};

HOST_DEVICE bool comes_before(const Meeting& a, const Meeting& b) {
    if (b.other < 0) return a.other >= 0;
    return a.other >= 0 && (a.touch.entry < b.touch.entry || (a.touch.entry == b.touch.entry && a.touch.distance < b.touch.distance));
}

template <class Motion> struct TouchSearch {  // of a node against a body
    const Motion* motion;
    double thickness;
    double x[3], s[3];   // the node's place and displacement
    Box box;
    Meeting nearest, first;
    Meeting beside;      // of the triangles that the vertex is over and near, the nearest after `nearest`
};

template <class Motion> HOST_DEVICE TouchSearch<Motion> search_of(const Motion& m, int node, double thickness) {
    TouchSearch<Motion> search = {&m, thickness, {}, {}, box_of(m, node, DEEP * thickness), {-1, -1, {}}, {-1, -1, {}}, {-1, -1, {}}};
    place_of(m, node, search.x);  // only the nearest triangle of all tells inside from outside, hence DEEP
    displacement_of(m, node, search.s);
    return search;
}

// True if a vertex lies over a triangle, within the thickness.
HOST_DEVICE bool is_over(const Meeting& m, double thickness) {
    return m.other >= 0 && m.touch.certainty > OVER_FACE && m.touch.distance > 0 && m.touch.distance <= thickness;
}

template <class Motion> HOST_DEVICE void consider(const SurfaceTables& c, int body, int triangle, TouchSearch<Motion>& search) {
    const int* t = c.triangle + 3 * triangle;
    const double thickness = search.thickness;
    double path[3] = {search.s[0], search.s[1], search.s[2]}, x[3][3];
    for (int a = 0; a < 3; ++a) {
        double d[3];
        place_of(*search.motion, t[a], x[a]);
        displacement_of(*search.motion, t[a], d);
        for (int k = 0; k < 3; ++k) path[k] -= d[k] / 3;
    }
    Meeting here = {body, triangle, {}}, &nearest = search.nearest;
    if (!meet(search.x, path, x[0], x[1], x[2], thickness, here.touch)) return;
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

// Searches a body's tree, once for all searches.
template <class Motion> HOST_DEVICE void search_tree(const SurfaceTables& c, int body, TouchSearch<Motion>* search, int count) {
    Box box = search[0].box;
    for (int i = 1; i < count; ++i) box = joined(box, search[i].box);
    int stack[64], depth = 0;
    stack[depth++] = c.tree_start[body];
    while (depth) {
        const int k = stack[--depth], left = c.tree_child[2 * k];
        if (!meet(c.tree_box[k], box)) continue;
        if (left >= 0) {
            stack[depth++] = left;
            stack[depth++] = c.tree_child[2 * k + 1];
            continue;
        }
        for (int i = 0; i < count; ++i)
            if (count == 1 || meet(c.tree_box[k], search[i].box)) consider(c, body, ~left, search[i]);
    }
}

// Where a vertex touches the body: on the nearest triangle if it is near, or inside, else where its path first comes near.
template <class Motion> HOST_DEVICE const Meeting& found_by(const TouchSearch<Motion>& search) {
    const double distance = search.nearest.touch.distance;
    if (search.nearest.other < 0 || distance <= search.thickness) return search.nearest;
    return search.first.other >= 0 || distance > 2 * search.thickness ? search.first : search.nearest;
}

enum Passage { STAYS_OUT = 0, GOES_THROUGH = 1, COMES_INSIDE = 2 };

// Searches that tell what a solution does to a vertex: along its way past triangles, and near them, and where it has arrived.
template <class Motion>
HOST_DEVICE void searches_of_passage(const Motion& m, const Motion& ended, int node, double thickness, TouchSearch<Motion>* search) {
    search[0] = search_of(m, node, THROUGH * thickness);
    search[1] = search_of(m, node, thickness);
    search[2] = search_of(ended, node, INSIDE * thickness);
}
template <class Motion> HOST_DEVICE Passage passage_found(const TouchSearch<Motion>* search, Meeting& found) {
    const Meeting &through = found_by(search[0]), &on_way = found_by(search[1]), &there = found_by(search[2]);
    if (through.other >= 0 && through.touch.entry <= 1 && on_way.other >= 0) {
        found = on_way;
        return GOES_THROUGH;
    }
    found = there;
    const bool enters = there.other >= 0 && there.touch.distance < 0 && (on_way.other < 0 || on_way.touch.distance >= 0);
    return enters ? COMES_INSIDE : STAYS_OUT;
}

// What a solution does to a vertex: whether it goes through a triangle of a body, or comes inside of it. found: where it touches then.
// ended: the motion of what has arrived: x where it is, nothing moves.
template <class Motion>
HOST_DEVICE Passage passage_of(const SurfaceTables& c, const Motion& m, const Motion& ended, int node, int body, double thickness, Meeting& found) {
    TouchSearch<Motion> search[3];
    searches_of_passage(m, ended, node, thickness, search);
    search_tree(c, body, search, 3);
    return passage_found(search, found);
}

// --- rows ---------------------------------------------------------------------------------------------------------------------------

struct RowMemory {       // what a row remembers of the last step
    int other;
    double force, hardening, normal[3], traction[3];
};

template <class Tables> HOST_DEVICE RowMemory memory_of(const Tables& c, int row) {
    RowMemory m = {c.obstacle[row], c.force[row], c.hardening[row], {}, {}};
    for (int k = 0; k < 3; ++k) {
        m.normal[k] = c.normal[3 * row + k];
        m.traction[k] = c.traction[3 * row + k];
    }
    return m;
}

// Takes up the forces of the row of memory that touched the same, if there is one.
template <class Tables> HOST_DEVICE void recall(const Tables& c, int row, const RowMemory* last, int count) {
    for (int r = 0; r < count; ++r) {
        if (last[r].other != c.obstacle[row]) continue;
        c.force[row] = last[r].force;
        c.hardening[row] = last[r].hardening;
        for (int k = 0; k < 3; ++k) c.traction[3 * row + k] = last[r].traction[k];
        turn_with(last[r].normal, c.normal + 3 * row, c.traction + 3 * row);
    }
}

// Makes a row of where a vertex touches a body; of none an empty one. It has no forces.
template <class Motion> HOST_DEVICE void put_row(const SurfaceTables& c, const Motion& m, int row, int site, const Meeting& t) {
    c.obstacle[row] = t.other;
    c.force[row] = 0;
    c.entry[row] = NEVER;
    c.hardening[row] = 1;
    for (int k = 0; k < 3; ++k) c.traction[3 * row + k] = 0;
    if (t.other < 0) return;
    const int body = c.site_body[site];
    const double own = c.stiffness[2 * site];
    int* corner = c.corner + CORNERS * row;
    double *weight = c.weight + CORNERS * row, *normal = c.normal + 3 * row, gap = 0, stiffness = 0;
    corner[0] = node_of_site(c, site);
    weight[0] = 1;
    for (int a = 0; a < 3; ++a) {
        corner[a + 1] = c.triangle[3 * t.triangle + a];
        weight[a + 1] = -t.touch.weight[a];
        const int facing = c.node_site[corner[a + 1]];
        stiffness += t.touch.weight[a] * (facing < 0 ? own : c.stiffness[2 * facing]);  // a fixed node has none
    }
    for (int k = 0; k < 3; ++k) {
        normal[k] = t.touch.normal[k];
        for (int a = 0; a < CORNERS; ++a) gap += normal[k] * weight[a] * (double)m.x[3 * (long long)corner[a] + k];
    }
    c.gap[row] = gap;
    c.entry[row] = t.touch.entry;
    c.stiffness[row] = 2 * own * stiffness / (own + stiffness);
    c.friction[row] = c.pair_friction[body * c.bodies + t.other];
    c.thickness[row] = 0.5 * (thickness_of(c, body) + thickness_of(c, t.other));
}

// How well a memory fits a row: -2: it is of another body.
HOST_DEVICE double fit_of(const SurfaceTables& c, int row, const RowMemory& last) {
    return last.other < 0 || last.other != c.obstacle[row] ? -2 : dot3(last.normal, c.normal + 3 * row);
}

// Takes up the forces of two rows of a vertex, each of which is of the row that it fits best.
HOST_DEVICE void recall_both(const SurfaceTables& c, int row, const RowMemory* last) {
    const double straight[2] = {fit_of(c, row, last[0]), fit_of(c, row + 1, last[1])}, crossed[2] = {fit_of(c, row, last[1]), fit_of(c, row + 1, last[0])};
    const bool cross = fmax(crossed[0], crossed[1]) > fmax(straight[0], straight[1]);
    recall(c, row, last + cross, 1);
    recall(c, row + 1, last + !cross, 1);
}

// True if a vertex lies in a crease of a body, where the normal of the nearest triangle alone would jump to and fro.
template <class Motion> HOST_DEVICE bool in_crease(const TouchSearch<Motion>& search) {
    const Touch &nearest = search.nearest.touch, &beside = search.beside.touch;
    return search.beside.other >= 0 && nearest.distance > 0 && nearest.distance <= search.thickness && dot3(nearest.normal, beside.normal) < CREASE;
}

struct NothingElse {  // of a body itself, which is not touched
#ifdef __CUDACC_RTC__
    template <class F> __device__ void operator()(F) const {}
#else
    template <class F> void operator()(F) const {}
#endif
};

// Sets both rows of a site between bodies: of the bodies that it meets first, or is nearest to, or, with one, of both sides of a crease.
// own(f): f(search) of the body itself, if the site may touch it
template <class Motion, class Own = NothingElse> HOST_DEVICE void detect_site(const SurfaceTables& c, const Motion& m, int site, Own own = {}) {
    const int node = node_of_site(c, site), body = c.site_body[site], row = c.pair_first + 2 * site;
    Meeting first = {-1, -1, {}}, second = first, beside = first;
    const Box box = m.free[node] == 0 ? empty_box() : box_of(m, node, thickness_of(c, body));
    auto take = [&](const TouchSearch<Motion>& search) {
        const Meeting t = found_by(search);
        if (comes_before(t, first)) { second = first; first = t; }
        else if (comes_before(t, second)) second = t;
        if (in_crease(search) && comes_before(search.beside, beside)) beside = search.beside;
    };
    for (int other = 0; other < c.bodies; ++other) {
        if (other == body || !(c.near[other] & 1) || !meet(box, c.body_box[other])) continue;
        TouchSearch<Motion> search = search_of(m, node, 0.5 * (thickness_of(c, body) + thickness_of(c, other)));
        search_tree(c, other, &search, 1);
        take(search);
    }
    if (m.free[node] != 0) own(take);
    if (second.other < 0) second = beside;
    const RowMemory last[2] = {memory_of(c, row), memory_of(c, row + 1)};
    put_row(c, m, row, site, first);
    put_row(c, m, row + 1, site, second);
    recall_both(c, row, last);
}
