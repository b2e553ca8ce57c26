// SPDX-License-Identifier: MIT
// Detection of contacts between bodies on a CPU (kernels/pair_detection.cuh): before a solve, and the sweep of the paths that it found.
#pragma once
#include <algorithm>

#include "island_groups.h"
#include "loop.h"
#include "own_contact.h"

constexpr int MAY_TOUCH_ITSELF = 2;  // bit of Contact::near
constexpr int PAIR_HOLDS = 40;  // rounds in which bodies that pass through each other are held apart

struct PairDetection {
    typedef SurfaceMotion<double, double> Motion;
    const Loop& loop;
    Contact& c;
    const SurfaceTables tables;
    const EdgeTables edges;
    const Motion motion;
    const OwnSearch own;

    // y: solution found, material frame; null: before the solve
    PairDetection(const Loop& loop, Contact& c, const double* y = nullptr)
        : loop(loop), c(c), tables{loop.bodies, c.body_start, c.corner, c.weight, c.obstacle, c.normal, c.gap, c.entry, c.stiffness, c.friction,
                                   c.thickness, c.hardening, c.force, c.traction, c.pair_first, c.site_body, c.node_site, c.triangle, c.tree_start,
                                   c.tree_child, c.tree_box, c.body_box, c.near, c.pair_friction, c.body_thickness},
          edges{c.edge_start, c.edge, c.edge_opposite, c.triangle_edge, c.edge_length, c.wings, c.facing}, motion(motion_of(c, loop.x, y)), own{c, tables, edges, motion, c.own} {}

    int edges_before(int body) const { return c.edge_start ? (c.edge_start[body] - c.edge_start[0]) / 2 : 0; }

    // before: the solve
    void fit(bool before = false) const {
        for (int i = 0; i < loop.bodies; ++i) {
            if (loop.bodies > 1) fit_body(tables, motion, i);
            c.near[i] = c.touched[i] = 0;
        }
        for (int i = 0; i < loop.bodies; ++i)
            for (int j = 0; j < i; ++j)
                if (c.between && meet(c.body_box[i], c.body_box[j])) c.near[i] = c.near[j] = 1;
        find_own(before);
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i)
            if (c.near[i]) {
                fit_tree(tables, motion, i);
                for (int edge = edges_before(i); edge < edges_before(i + 1); ++edge) fit_wings(edges, motion, edge);
            }
    }

    // Finds the bodies that may touch themselves.
    void find_own(bool before) const {
        if (!own.exists()) return;
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i) {
            if (!before) own.add_ways(i);
            bool may = before ? own.begin(i) : own.any_may_pass(i);
            if (before && may && own.wants_reference(i)) {
                fit_tree(tables, motion, i);
                own.measure(i);
                may = own.any_may_touch(i, 2);
            }
            if (may) c.near[i] |= MAY_TOUCH_ITSELF;
        }
    }
    // Sets the rows that a site may have with its own body, too.
    void detect_site_and_own(int body, int site) const {
        const int node = node_of_site(tables, site);
        detect_site(tables, motion, site, [&](auto take) {
            if (!(c.near[body] & MAY_TOUCH_ITSELF) || is_bound(node, body) || !own.site_may_touch(site, body, 2)) return;
            take(search_own(tables, c.own.near, motion, body, node, thickness_of(tables, body), c.own.apart + site));
        });
    }
    // What an edge may touch of its own body.
    EdgeMeetings own_edges(int body, int edge) const {
        EdgeMeetings found = no_edges();
        if (!own.exists() || !(c.near[body] & MAY_TOUCH_ITSELF) || !own.edge_may_touch(edge, body, 2)) return found;
        meet_each_own_edge(tables, edges, c.own.near, motion, body, edge, c.own.edges_apart + edge, [&](const EdgeMeeting& here) {
            if (!are_bound(edge, body, here.edge, body)) take(found, here);
        });
        return found;
    }

    // Sets the rows of a step.
    void run() const {
        fit(true);
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i) {
            if (!c.near[i] && !c.was_near[i]) continue;
            for (int site = sites_before(tables, i); site < sites_before(tables, i + 1); ++site) detect_site_and_own(i, site);
            for (int edge = edges_before(i); edge < edges_before(i + 1); ++edge) {
                if (!c.near[i]) c.wings[edge].sharp = 0;
                count_dropped(edge, detect_edge(tables, edges, motion, i, edge, own_edges(i, edge)));
            }
        }
        std::copy(c.near, c.near + loop.bodies, c.was_near);
    }

    // Gives vertices that the solution moves through a triangle, or into a body that they were outside of, a row there, or makes theirs
    // stiffer; edges that it moves through edges likewise. True if there are such. room: memory, 4 doubles a node, for where nodes come
    // to and how far at most those of a body move. detected: the rows are those of `run`, so that a vertex that moves less than it was
    // away need not be looked at.
    bool sweep(double* room, bool detected) const {
        fit();
        double* farthest = room + 3 * (int64_t)loop.nodes;
        const Motion ended = arrived(room, farthest);
        bool found = false;
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) reduction(|| : found) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i)
            for (int site = sites_before(tables, i); c.near[i] && site < sites_before(tables, i + 1); ++site)
                found = sweep_site(site, ended, detected ? farthest : nullptr) || found;
        for (int i = 0; i < loop.bodies; ++i)
            for (int edge = edges_before(i); c.near[i] && edge < edges_before(i + 1); ++edge) found = sweep_edge(i, edge) || found;
        // rows of this step, whether found before the solve or here, count in its islands and are looked at again in the next one
        for (int i = 0; i < loop.bodies; ++i) c.near[i] = c.was_near[i] = c.near[i] | c.was_near[i];
        return found;
    }
    // The motion of what has arrived. ends: (nodes, 3) memory. farthest: (bodies,) out, how far nodes move at most [m]; null: not wanted
    Motion arrived(double* ends, double* farthest = nullptr) const {
        for (int i = 0; i < loop.bodies; ++i) {
            double most = 0;
            for (int node = loop.body[i].first; c.near[i] && node < loop.body[i].last; ++node) {
                double* end = ends + 3 * (int64_t)node;
                displacement_of(motion, node, end);
                most = std::fmax(most, std::sqrt(dot3(end, end)));
                for (int k = 0; k < 3; ++k) end[k] += loop.x[3 * (int64_t)node + k];
            }
            if (farthest) farthest[i] = most;
        }
        Motion ended = motion;
        ended.x = ends;
        ended.predictor = nullptr;
        return ended;
    }

    // True if a node is attached to a body: the two do not touch.
    bool is_bound(int node, int body) const { return c.ties.count && c.ties.bound[node] == body + 1; }
    // The same of two edges.
    bool are_bound(int edge, int body, int facing, int other) const {
        return is_bound(c.edge[2 * edge], other) || is_bound(c.edge[2 * edge + 1], other) || is_bound(c.edge[2 * facing], body) ||
               is_bound(c.edge[2 * facing + 1], body);
    }

    // Moves nodes so that what y still takes through another body stays in front of it: along the normal where they touch, both sides
    // by their masses, which keeps their momentum. Counts the nodes in the reports of both bodies.
    void hold_back(double* ends, double* y) const {
        std::copy(c.near, c.near + loop.bodies, c.was_near);
        for (int k = 0; k < PAIR_HOLDS; ++k) {
            fit();
            const Motion ended = arrived(ends);
            bool found = false;
            for (int i = 0; i < loop.bodies; ++i) {
                if (!c.near[i] || c.result[i].status == NOT_FINITE) continue;
                for (int site = sites_before(tables, i); site < sites_before(tables, i + 1); ++site) found = hold_site(i, site, ended, y) || found;
                for (int edge = edges_before(i); edge < edges_before(i + 1); ++edge) found = hold_edge(i, edge, y) || found;
            }
            if (!found) break;
        }
        for (int i = 0; i < loop.bodies; ++i) c.near[i] = c.was_near[i] = c.near[i] | c.was_near[i];
    }
    bool hold_site(int body, int site, const Motion& ended, double* y) const {
        const int node = node_of_site(tables, site);
        if (c.free[node] == 0) return false;
        const Box box = box_of(motion, node, thickness_of(tables, body));
        bool found = false;
        for (int other = 0; other < loop.bodies; ++other) {
            if (other == body || !(c.near[other] & 1) || is_bound(node, other) || c.result[other].status == NOT_FINITE) continue;
            if (!meet(box, c.body_box[other])) continue;
            const double thickness = 0.5 * (thickness_of(tables, body) + thickness_of(tables, other));
            Meeting t;
            if (passage_of(tables, motion, ended, node, other, thickness, t) == STAYS_OUT) continue;
            found = hold_vertex(body, node, t, y) || found;
        }
        Meeting t;
        return (site_passes_own(body, site, t) && hold_vertex(body, node, t, y)) || found;
    }
    bool hold_vertex(int body, int node, const Meeting& t, double* y) const {
        const int32_t* corner = c.triangle + 3 * t.triangle;
        const int32_t nodes[CORNERS] = {node, corner[0], corner[1], corner[2]};
        const double *w = t.touch.weight, weight[CORNERS] = {1, -w[0], -w[1], -w[2]};
        const double thickness = 0.5 * (thickness_of(tables, body) + thickness_of(tables, t.other));
        return hold_apart(nodes, weight, t.touch.normal, 0.1 * thickness, body, t.other, y);
    }
    // True if the solution takes a vertex through its own body. t: where it touches then.
    bool site_passes_own(int body, int site, Meeting& t) const {
        const int node = node_of_site(tables, site);
        if (!own.exists() || !(c.near[body] & MAY_TOUCH_ITSELF) || is_bound(node, body) || !own.site_may_pass(site, body)) return false;
        return passes_own(tables, c.own.near, motion, body, node, thickness_of(tables, body), t);
    }
    // f(other, facing, thickness, touch) of the edges that the solution takes an edge through, but for attached ones.
    template <class F> void each_edge_passed(int body, int edge, F f) const {
        each_facing_edge(tables, edges, motion, body, edge, [&](int other, int facing, double thickness) {
            if (are_bound(edge, body, facing, other)) return;
            const EdgePath path = path_of(edges, motion, edge), way = path_of(edges, motion, facing);
            EdgeTouch t;
            if (!edges_pass(path, c.wings[edge], way, c.wings[facing], THROUGH * thickness)) return;
            if (meet_edges(path, c.wings[edge], way, c.wings[facing], thickness, 1e-2 * thickness, nullptr, t)) f(other, facing, thickness, t);
        });
        if (!own.exists() || !(c.near[body] & MAY_TOUCH_ITSELF) || !own.edge_may_pass(edge, body)) return;
        const EdgePath path = path_of(edges, motion, edge);
        each_own_edge(tables, edges, c.own.near, motion, body, edge, [&](int facing) {
            EdgeTouch t;
            if (are_bound(edge, body, facing, body) || !own_edges_pass(path, path_of(edges, motion, facing), thickness_of(tables, body), t)) return;
            f(body, facing, thickness_of(tables, body), t);
        });
    }
    bool hold_edge(int body, int edge, double* y) const {
        bool found = false;
        each_edge_passed(body, edge, [&](int other, int facing, double thickness, const EdgeTouch& t) {
            if (c.result[other].status == NOT_FINITE) return;
            const int32_t nodes[CORNERS] = {c.edge[2 * edge], c.edge[2 * edge + 1], c.edge[2 * facing], c.edge[2 * facing + 1]};
            const double weight[CORNERS] = {1 - t.s, t.s, t.t - 1, -t.t};
            found = hold_apart(nodes, weight, t.normal, 0.1 * thickness, body, other, y) || found;
        });
        return found;
    }
    // Moves nodes by their weights over their masses until sum_a weight_a x_a is `gap` along the normal; weights above 0 are of `body`.
    // Those of a body whose step is made stay. False if there is nothing to move.
    bool hold_apart(const int32_t* nodes, const double* weight, const double* normal, double gap, int body, int other, double* y) const {
        double lacks = gap, share = 0;
        auto moves = [&](int a) { return c.free[nodes[a]] != 0 && !is_made(loop, weight[a] > 0 ? body : other); };
        for (int a = 0; a < CORNERS; ++a) {
            double s[3];
            displacement_of(motion, nodes[a], s);
            for (int k = 0; k < 3; ++k) lacks -= weight[a] * normal[k] * (loop.x[3 * (int64_t)nodes[a] + k] + s[k]);
            if (moves(a)) share += weight[a] * weight[a] / c.mass[nodes[a]];
        }
        if (!(lacks > 0) || !(share > 0)) return false;
        for (int a = 0; a < CORNERS; ++a) {
            if (!moves(a) || weight[a] == 0) continue;
            double dv[3], own[3];
            for (int k = 0; k < 3; ++k) dv[k] = lacks / share * weight[a] / c.mass[nodes[a]] * normal[k] / c.dx_dv;
            rotated_back(c.rotation + 9 * (int64_t)nodes[a], dv, own);
            for (int k = 0; k < 3; ++k) y[3 * (int64_t)nodes[a] + k] += own[k];
        }
        ++c.report[body].clipped;
        if (other != body) ++c.report[other].clipped;
        return true;
    }

    void count_dropped(int edge, int rows) const {
        for (int end = 0; end < 2 && rows; ++end)
            if (const int site = c.node_site[c.edge[2 * edge + end]]; site >= 0) { c.dropped[site] += rows; return; }
    }

    // The same for an edge that the solution takes through another one.
    bool sweep_edge(int body, int edge) const {
        bool found = false;
        each_edge_passed(body, edge, [&](int other, int facing, double, const EdgeTouch& t) {
            take_edge_row(body, edge, {other, facing, t});
            c.touched[body] = c.touched[other] = 1;
            found = true;
        });
        return found;
    }
    void take_edge_row(int body, int edge, const EdgeMeeting& t) const {
        const int row = c.edge_start[0] + 2 * edge;
        const int32_t* facing = c.facing + 2 * edge;
        int k = row;
        if (facing[0] != t.edge || c.obstacle[row] < 0) {
            const bool next = c.obstacle[row + 1] < 0 || facing[1] == t.edge;
            k += next || (c.obstacle[row] >= 0 && c.state[row + 1].force.normal < c.state[row].force.normal);
        }
        RowState& state = c.state[k];
        const bool same = c.obstacle[k] >= 0 && facing[k - row] == t.edge;
        if (same && dot3(c.normal + 3 * k, t.touch.normal) > SAME_PLANE) {
            c.hardening[k] = std::min(HARDER * c.hardening[k], HARDEST);
            return;
        }
        put_edge_row(tables, edges, motion, k, body, t);
        take_anew(state);
    }

    // How far a vertex is at least from a body at the start of the step, as its rows tell, up to `thickness`.
    double distance_at_start(int site, int other, double thickness) const {
        const int row = c.pair_first + 2 * site;
        const bool full = c.obstacle[row] >= 0 && c.obstacle[row + 1] >= 0 && c.obstacle[row] != c.obstacle[row + 1];
        double least = thickness;
        bool known = !full;  // a body without a row is farther away than that, unless there was no place for one
        for (int r = row; r < row + 2; ++r) {
            if (c.obstacle[r] != other) continue;
            known = true;
            least = std::fmin(least, c.gap[r]);
        }
        return known ? least : -1;
    }

    // farthest: (bodies,) of each body's nodes [m]; null: all that is near is looked at
    bool sweep_site(int site, const Motion& ended, const double* farthest) const {
        const int node = node_of_site(tables, site), body = c.site_body[site];
        if (c.free[node] == 0) return false;
        const Box box = box_of(motion, node, thickness_of(tables, body));
        double s[3];
        displacement_of(motion, node, s);
        const double own = std::sqrt(dot3(s, s));
        bool found = false;
        for (int other = 0; other < loop.bodies; ++other) {
            if (other == body || !(c.near[other] & 1) || is_bound(node, other) || !meet(box, c.body_box[other])) continue;
            const double thickness = 0.5 * (thickness_of(tables, body) + thickness_of(tables, other));
            if (farthest && own + farthest[other] < distance_at_start(site, other, thickness) - THROUGH * thickness) continue;
            Meeting t;
            if (passage_of(tables, motion, ended, node, other, thickness, t) == STAYS_OUT) continue;
            take_row(c.pair_first + 2 * site, site, t);
#pragma omp atomic write
            c.touched[body] = 1;
#pragma omp atomic write
            c.touched[other] = 1;
            found = true;
        }
        if (Meeting t; site_passes_own(body, site, t)) {
            take_row(c.pair_first + 2 * site, site, t);
            c.touched[body] = 1;
            found = true;
        }
        return found;
    }
    void take_row(int pair, int site, const Meeting& t) const {
        const int k = row_for(c, pair, t.other, t.touch.normal);
        const bool same = c.obstacle[k] == t.other;
        RowState& state = c.state[k];
        if (same && dot3(c.normal + 3 * k, t.touch.normal) > SAME_PLANE) {
            c.hardening[k] = std::min(HARDER * c.hardening[k], HARDEST);
            return;
        }
        put_row(tables, motion, k, site, t);
        take_anew(state);
    }
};
