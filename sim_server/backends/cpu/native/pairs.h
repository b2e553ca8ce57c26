// SPDX-License-Identifier: MIT
// Detection of contacts between bodies on a CPU: each vertex of a surface against the triangles of the others, along the paths that
// gravity alone would make (kernels/vertex_triangle.cuh). A vertex has two rows, for the two bodies that it meets first, or is nearest
// to; a row remembers its forces as long as the vertex touches the same body, on whichever triangle.
//
// A body has a tree of boxes over its triangles, made once, whose boxes are fitted anew in each step in which its own box meets
// another's. Children come after their parents.
#pragma once
#include <algorithm>
#include <cmath>

#include "loop.h"
#include "vertex_triangle.cuh"

static const Box NOWHERE = {{INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}};

static void include(Box& box, const double* x, double margin) {
    for (int k = 0; k < 3; ++k) {
        box.low[k] = std::fmin(box.low[k], x[k] - margin);
        box.high[k] = std::fmax(box.high[k], x[k] + margin);
    }
}
static Box joined(const Box& a, const Box& b) {
    Box box = a;
    include(box, b.low, 0);
    include(box, b.high, 0);
    return box;
}
static bool meet(const Box& a, const Box& b) {
    for (int k = 0; k < 3; ++k)
        if (!(a.low[k] <= b.high[k] && b.low[k] <= a.high[k])) return false;
    return true;
}

struct Meeting {
    int32_t other;       // body; -1: none
    int32_t triangle;
    Touch touch;
};

static bool comes_before(const Meeting& a, const Meeting& b) {
    if (b.other < 0) return a.other >= 0;
    return a.other >= 0 && (a.touch.entry < b.touch.entry || (a.touch.entry == b.touch.entry && a.touch.distance < b.touch.distance));
}

constexpr double THROUGH = 1e-3;  // thicknesses: a vertex whose path comes so near passes the triangle
constexpr double INSIDE = 3;  // thicknesses over DEEP: how deep a vertex may have come in one step to be sent back

struct PairDetection {
    const Loop& loop;
    Contact& c;
    const double* y = nullptr;  // solution found, material frame; null: before the solve
    const double* reached = nullptr;  // (nodes, 3) positions that nothing moves any more; null: those at the start of the step

    const double* x(int node) const { return (reached ? reached : loop.x) + 3 * (int64_t)node; }
    // Displacement of a node in the step: under gravity alone, or by the solution.
    void drifted(int node, double* s) const {
        if (reached) { s[0] = s[1] = s[2] = 0; return; }
        if (y) {
            rotated(c.rotation + 9 * (int64_t)node, y + 3 * (int64_t)node, s);
            for (int k = 0; k < 3; ++k) s[k] = c.dx_dv * (c.predictor[3 * (int64_t)node + k] + s[k]);
            return;
        }
        for (int k = 0; k < 3; ++k) {
            const double g = c.free[node] == 0 ? 0 : c.force_coefficient * c.gravity[k];
            s[k] = c.dx_dv * (c.predictor[3 * (int64_t)node + k] + g);
        }
    }
    Box box_of(int node, double margin) const {
        Box box = NOWHERE;
        double s[3], end[3];
        drifted(node, s);
        for (int k = 0; k < 3; ++k) end[k] = x(node)[k] + s[k];
        include(box, x(node), margin);
        include(box, end, margin);
        return box;
    }
    int sites(int body) const { return c.body_start[body] / 2; }
    int node_of(int site) const { return c.corner[CORNERS * 2 * site]; }
    double thickness_of(int body) const { return c.body_start[body] < c.body_start[body + 1] ? c.thickness[c.body_start[body]] : 0; }

    void fit_body(int body) const {
        Box box = NOWHERE;
        for (int site = sites(body); site < sites(body + 1); ++site) box = joined(box, box_of(node_of(site), thickness_of(body)));
        for (int k = c.tree_start[body]; k < c.tree_start[body + 1]; ++k)
            for (int a = 0; a < 3 && c.tree_child[2 * k] < 0; ++a) {
                const int node = c.triangle[3 * ~c.tree_child[2 * k] + a];
                if (c.node_site[node] < 0) box = joined(box, box_of(node, thickness_of(body)));  // a fixed node
            }
        c.body_box[body] = box;
    }
    void fit_tree(int body) const {
        for (int k = c.tree_start[body + 1] - 1; k >= c.tree_start[body]; --k) {
            const int left = c.tree_child[2 * k], right = c.tree_child[2 * k + 1];
            if (left >= 0) { c.tree_box[k] = joined(c.tree_box[left], c.tree_box[right]); continue; }
            Box box = NOWHERE;
            for (int a = 0; a < 3; ++a) box = joined(box, box_of(c.triangle[3 * ~left + a], thickness_of(body)));
            c.tree_box[k] = box;
        }
    }

    // Where a vertex touches a body: on the nearest triangle if it is near, or inside, else where its path first comes near.
    Meeting touch_of(int node, int body, double thickness) const {
        Meeting nearest = {-1, -1, {}}, first = nearest;
        double s[3];
        drifted(node, s);
        const Box box = box_of(node, DEEP * thickness);  // only the nearest triangle of all tells inside from outside
        int32_t stack[64];
        int depth = 0;
        stack[depth++] = c.tree_start[body];
        while (depth) {
            const int k = stack[--depth], left = c.tree_child[2 * k];
            if (!meet(c.tree_box[k], box)) continue;
            if (left >= 0) {
                stack[depth++] = left;
                stack[depth++] = c.tree_child[2 * k + 1];
                continue;
            }
            consider(node, s, body, ~left, thickness, nearest, first);
        }
        const double distance = nearest.touch.distance;
        if (nearest.other < 0 || distance <= thickness) return nearest;
        if (first.other >= 0 || distance > 2 * thickness) return first;
        return nearest;
    }
    void consider(int node, const double* s, int body, int triangle, double thickness, Meeting& nearest, Meeting& first) const {
        const int32_t* t = c.triangle + 3 * triangle;
        double path[3] = {s[0], s[1], s[2]};
        for (int a = 0; a < 3; ++a) {
            double d[3];
            drifted(t[a], d);
            for (int k = 0; k < 3; ++k) path[k] -= d[k] / 3;
        }
        Meeting here = {body, triangle, {}};
        if (!meet(x(node), path, x(t[0]), x(t[1]), x(t[2]), thickness, here.touch)) return;
        const double farther = std::fabs(here.touch.distance) - std::fabs(nearest.touch.distance);
        const bool as_near = std::fabs(farther) <= 1e-9 * thickness;
        if (nearest.other < 0 || (as_near ? here.touch.certainty > nearest.touch.certainty : farther < 0)) nearest = here;
        if (here.touch.distance > 0 && here.touch.entry <= 1 && comes_before(here, first)) first = here;
    }

    struct Memory {
        int32_t other;
        double force, normal[3], traction[3];
    };
    Memory memory_of(int row) const {
        Memory m = {c.obstacle[row], c.force[row], {}, {}};
        for (int k = 0; k < 3; ++k) {
            m.normal[k] = c.normal[3 * row + k];
            m.traction[k] = c.traction[3 * row + k];
        }
        return m;
    }
    void put_row(int row, int site, const Meeting& t, const Memory* last) const {
        c.obstacle[row] = t.other;
        c.force[row] = 0;
        c.entry[row] = NEVER;
        for (int k = 0; k < 3; ++k) c.traction[3 * row + k] = 0;
        if (t.other < 0) return;
        const int node = node_of(site), body = c.site_body[site];
        const double own = c.stiffness[2 * site];
        int32_t* corner = c.corner + CORNERS * row;
        double *weight = c.weight + CORNERS * row, *normal = c.normal + 3 * row, gap = 0, stiffness = 0;
        corner[0] = node;
        weight[0] = 1;
        for (int a = 0; a < 3; ++a) {
            corner[a + 1] = c.triangle[3 * t.triangle + a];
            weight[a + 1] = -t.touch.weight[a];
            const int32_t facing = c.node_site[corner[a + 1]];
            stiffness += t.touch.weight[a] * (facing < 0 ? own : c.stiffness[2 * facing]);  // a fixed node has none
        }
        for (int k = 0; k < 3; ++k) {
            normal[k] = t.touch.normal[k];
            for (int a = 0; a < CORNERS; ++a) gap += normal[k] * weight[a] * loop.x[3 * (int64_t)corner[a] + k];
        }
        c.gap[row] = gap;
        c.entry[row] = t.touch.entry;
        c.stiffness[row] = 2 * own * stiffness / (own + stiffness);
        c.friction[row] = c.pair_friction[body * loop.bodies + t.other];
        c.thickness[row] = 0.5 * (thickness_of(body) + thickness_of(t.other));
        for (int r = 0; r < 2; ++r) {
            if (last[r].other != t.other) continue;
            c.force[row] = last[r].force;
            for (int k = 0; k < 3; ++k) c.traction[3 * row + k] = last[r].traction[k];
            turn_with(last[r].normal, normal, c.traction + 3 * row);
        }
    }

    void detect_site(int site) const {
        const int node = node_of(site), body = c.site_body[site], row = c.pair_first + 2 * site;
        Meeting first = {-1, -1, {}}, second = first;
        const Box box = c.free[node] == 0 ? NOWHERE : box_of(node, thickness_of(body));
        for (int other = 0; other < loop.bodies; ++other) {
            if (other == body || !c.near[other] || !meet(box, c.body_box[other])) continue;
            const Meeting t = touch_of(node, other, 0.5 * (thickness_of(body) + thickness_of(other)));
            if (comes_before(t, first)) { second = first; first = t; }
            else if (comes_before(t, second)) second = t;
        }
        const Memory last[2] = {memory_of(row), memory_of(row + 1)};
        put_row(row, site, first, last);
        put_row(row + 1, site, second, last);
    }

    // Gives vertices that the solution moves through a triangle, or into a body that they were outside of, a row there, or makes theirs
    // stiffer. True if there are such. ends: (nodes, 3) memory for where nodes come to.
    bool sweep(double* ends) const {
        fit();
        for (int i = 0; i < loop.bodies; ++i)
            for (int node = loop.body[i].first; c.near[i] && node < loop.body[i].last; ++node) {
                drifted(node, ends + 3 * (int64_t)node);
                for (int k = 0; k < 3; ++k) ends[3 * (int64_t)node + k] += x(node)[k];
            }
        bool found = false;
        for (int i = 0; i < loop.bodies; ++i)
            for (int site = sites(i); c.near[i] && site < sites(i + 1); ++site) found = sweep_site(site, ends) || found;
        // rows of this step, whether found before the solve or here, count in its islands and are looked at again in the next one
        for (int i = 0; i < loop.bodies; ++i) c.near[i] = c.was_near[i] = c.near[i] || c.was_near[i];
        return found;
    }
    bool sweep_site(int site, const double* ends) const {
        const int node = node_of(site), body = c.site_body[site];
        if (c.free[node] == 0) return false;
        const Box box = box_of(node, thickness_of(body));
        bool found = false;
        for (int other = 0; other < loop.bodies; ++other) {
            if (other == body || !c.near[other] || !meet(box, c.body_box[other])) continue;
            const double thickness = 0.5 * (thickness_of(body) + thickness_of(other));
            const Meeting through = touch_of(node, other, THROUGH * thickness);
            const bool passes = through.other >= 0 && through.touch.entry <= 1;
            const PairDetection end{loop, c, y, ends};
            const Meeting there = end.touch_of(node, other, INSIDE * thickness), t = touch_of(node, other, thickness);
            const bool enters = there.other >= 0 && there.touch.distance < 0 && (t.other < 0 || t.touch.distance >= 0);
            if (passes && t.other >= 0) take_row(c.pair_first + 2 * site, site, t);
            else if (enters) end.take_row(c.pair_first + 2 * site, site, there);
            else continue;
            c.touched[body] = c.touched[other] = 1;
            found = true;
        }
        return found;
    }
    void take_row(int pair, int site, const Meeting& t) const {
        const int k = row_for(c, pair, t.other);
        const bool same = c.obstacle[k] == t.other;
        const double n[3] = {c.normal[3 * k], c.normal[3 * k + 1], c.normal[3 * k + 2]};
        RowState& state = c.state[k];
        if (same && dot3(n, t.touch.normal) > SAME_PLANE) { state.hardening *= HARDER; return; }
        const Memory none[2] = {{-1, 0, {}, {}}, {-1, 0, {}, {}}};
        put_row(k, site, t, none);
        state.limit = 0;
        state.hardening = 1;
        state.in_set = 0;
    }

    void fit() const {
        for (int i = 0; i < loop.bodies; ++i) { fit_body(i); c.near[i] = c.touched[i] = 0; }
        for (int i = 0; i < loop.bodies; ++i)
            for (int j = 0; j < i; ++j)
                if (meet(c.body_box[i], c.body_box[j])) c.near[i] = c.near[j] = 1;
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i)
            if (c.near[i]) fit_tree(i);
    }

    // Sets the rows of a step.
    void run() const {
        fit();
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i) {
            if (!c.near[i] && !c.was_near[i]) continue;
            for (int site = sites(i); site < sites(i + 1); ++site) detect_site(site);
        }
        std::copy(c.near, c.near + loop.bodies, c.was_near);
    }
};
