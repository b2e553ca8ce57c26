// SPDX-License-Identifier: MIT
// Detection of contacts between bodies on a CPU (kernels/pair_detection.cuh): before a solve, and the sweep of the paths that it found.
#pragma once
#include <algorithm>
#include <vector>

#include "hold_apart.cuh"
#include "island_groups.h"
#include "loop.h"
#include "own_contact.h"

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
        Team::each(loop.threads, loop.bodies, [&](int i) {
            if (!c.near[i]) return;
            fit_tree(tables, motion, i);
            for (int edge = edges_before(i); edge < edges_before(i + 1); ++edge) fit_wings(edges, motion, edge);
        });
    }

    // Finds the bodies that may touch themselves.
    void find_own(bool before) const {
        if (!own.exists()) return;
        Team::each(loop.threads, loop.bodies, [&](int i) {
            if (!before) own.add_ways(i);
            bool may = before ? own.begin(i) : own.any_may_pass(i);
            if (before && may && own.wants_reference(i)) {
                fit_tree(tables, motion, i);
                own.measure(i);
                may = own.any_may_touch(i, 2);
            }
            if (may) c.near[i] |= MAY_TOUCH_ITSELF;
        });
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
        Team::each(loop.threads, loop.bodies, [&](int i) {
            if (!c.near[i] && !c.was_near[i]) return;
            for (int site = sites_before(tables, i); site < sites_before(tables, i + 1); ++site) detect_site_and_own(i, site);
            for (int edge = edges_before(i); edge < edges_before(i + 1); ++edge) {
                if (!c.near[i]) c.wings[edge].sharp = 0;
                count_dropped(edge, detect_edge(tables, edges, motion, i, edge, own_edges(i, edge)));
            }
        });
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
        std::atomic<bool> passes{false};
        Team::each(loop.threads, loop.bodies, [&](int i) {
            for (int site = sites_before(tables, i); c.near[i] && site < sites_before(tables, i + 1); ++site)
                if (sweep_site(site, ended, detected ? farthest : nullptr)) passes.store(true, std::memory_order_relaxed);
        });
        bool found = passes;
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

    // Moves nodes so that what y still takes through another body stays in front of it (hold_apart.cuh). Counts the places of
    // both bodies, and reports the most of an island for all of its bodies. Bodies whose step is made stay.
    void hold_back(double* ends, double* y) const {
        static thread_local std::vector<HeldPlace> places;
        static thread_local std::vector<int> held;
        held.assign(loop.bodies, 0);
        std::copy(c.near, c.near + loop.bodies, c.was_near);
        for (int k = 0; k < PAIR_HOLDS; ++k) {
            fit();
            const Motion ended = arrived(ends);
            places.clear();
            for (int i = 0; i < loop.bodies; ++i) {
                if (!c.near[i] || c.result[i].status == NOT_FINITE) continue;
                for (int site = sites_before(tables, i); site < sites_before(tables, i + 1); ++site) find_held_site(i, site, ended, places);
                for (int edge = edges_before(i); edge < edges_before(i + 1); ++edge) find_held_edge(i, edge, places);
            }
            bool moved = false;
            for (const HeldPlace& p : places) {
                auto moves = [&](int a) { return c.free[p.node[a]] != 0 && !is_made(loop, p.weight[a] > 0 ? p.body : p.other); };
                if (!hold_apart(motion, c.mass, p, y, moves)) continue;
                ++held[p.body];
                if (p.other != p.body) ++held[p.other];
                moved = true;
            }
            if (!moved) break;
        }
        for (int island = 0; island < c.islands; ++island) {
            int most = 0;
            for (int k = c.island_start[island]; k < c.island_start[island + 1]; ++k) most = std::max(most, held[c.island[k]]);
            for (int k = c.island_start[island]; k < c.island_start[island + 1]; ++k) c.report[c.island[k]].clipped += most;
        }
        for (int i = 0; i < loop.bodies; ++i) c.near[i] = c.was_near[i] = c.near[i] | c.was_near[i];
    }
    void find_held_site(int body, int site, const Motion& ended, std::vector<HeldPlace>& places) const {
        const int node = node_of_site(tables, site);
        if (c.free[node] == 0) return;
        const Box box = box_of(motion, node, thickness_of(tables, body));
        for (int other = 0, found = 0; other < loop.bodies && found < MOST_HELD; ++other) {
            if (other == body || !(c.near[other] & 1) || is_bound(node, other) || c.result[other].status == NOT_FINITE) continue;
            if (!meet(box, c.body_box[other])) continue;
            const double thickness = 0.5 * (thickness_of(tables, body) + thickness_of(tables, other));
            Meeting t;
            if (passage_of(tables, motion, ended, node, other, thickness, t) == STAYS_OUT) continue;
            places.push_back(held_vertex(tables, node, body, t, thickness));
            ++found;
        }
        Meeting t;
        if (site_passes_own(body, site, t)) places.push_back(held_vertex(tables, node, body, t, thickness_of(tables, body)));
    }
    // True if the solution takes a vertex through its own body. t: where it touches then.
    bool site_passes_own(int body, int site, Meeting& t) const {
        const int node = node_of_site(tables, site);
        if (!own.exists() || !(c.near[body] & MAY_TOUCH_ITSELF) || is_bound(node, body) || !own.site_may_pass(site, body)) return false;
        return passes_own(tables, c.own.near, motion, body, node, thickness_of(tables, body), t);
    }
    // f(other, facing, thickness, touch) of the edges that the solution takes an edge through, but for attached ones.
    template <class F> void each_edge_passed(int body, int edge, F f) const {
        ::each_edge_passed(tables, edges, motion, body, edge, [&](int other, int facing, double thickness, const EdgeTouch& t) {
            if (!are_bound(edge, body, facing, other)) f(other, facing, thickness, t);
        });
        if (!own.exists() || !(c.near[body] & MAY_TOUCH_ITSELF) || !own.edge_may_pass(edge, body)) return;
        each_own_edge_passed(tables, edges, c.own.near, motion, body, edge, [&](int facing, const EdgeTouch& t) {
            if (!are_bound(edge, body, facing, body)) f(body, facing, thickness_of(tables, body), t);
        });
    }
    void find_held_edge(int body, int edge, std::vector<HeldPlace>& places) const {
        int found = 0;
        each_edge_passed(body, edge, [&](int other, int facing, double thickness, const EdgeTouch& t) {
            if (c.result[other].status == NOT_FINITE || found++ >= MOST_HELD) return;
            places.push_back(held_edges(c.edge + 2 * edge, c.edge + 2 * facing, body, other, t.s, t.t, t.normal, thickness));
        });
    }

    void count_dropped(int edge, int rows) const {
        if (!rows) return;
        if (const int site = site_of_edge(tables, edges, edge); site >= 0) c.dropped[site] += rows;
    }

    // The same for an edge that the solution takes through another one.
    bool sweep_edge(int body, int edge) const {
        bool found = false;
        each_edge_passed(body, edge, [&](int other, int facing, double, const EdgeTouch& t) {
            const int k = take_edge_row(tables, edges, motion, body, edge, {other, facing, t}, [&](int row) { return c.state[row].force.normal; });
            if (k >= 0) take_anew(c.state[k]);
            c.touched[body] = c.touched[other] = 1;
            found = true;
        });
        return found;
    }
    // How far a vertex is at least from a body at the start of the step, as its rows tell, up to `thickness`.
    double distance_at_start(int site, int other, double thickness) const {
        const int row = c.pair_first + 2 * site;
        if (c.ties.count && c.ties.bound[node_of_site(tables, site)]) return -1;  // attachments have taken rows away
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
