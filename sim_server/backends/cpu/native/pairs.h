// SPDX-License-Identifier: MIT
// Detection of contacts between bodies on a CPU (kernels/pair_detection.cuh): before a solve, and the sweep of the paths that it found.
#pragma once
#include <algorithm>

#include "loop.h"

struct PairDetection {
    typedef SurfaceMotion<double, double> Motion;
    const Loop& loop;
    Contact& c;
    const SurfaceTables tables;
    const Motion motion;

    // y: solution found, material frame; null: before the solve
    PairDetection(const Loop& loop, Contact& c, const double* y = nullptr)
        : loop(loop), c(c), tables{loop.bodies, c.body_start, c.corner, c.weight, c.obstacle, c.normal, c.gap, c.entry, c.stiffness, c.friction,
                                   c.thickness, c.hardening, c.force, c.traction, c.pair_first, c.site_body, c.node_site, c.triangle, c.tree_start,
                                   c.tree_child, c.tree_box, c.body_box, c.near, c.pair_friction},
          motion{loop.x, c.predictor, y, c.rotation, c.free, c.dx_dv, c.force_coefficient, c.gravity} {}

    void fit() const {
        for (int i = 0; i < loop.bodies; ++i) { fit_body(tables, motion, i); c.near[i] = c.touched[i] = 0; }
        for (int i = 0; i < loop.bodies; ++i)
            for (int j = 0; j < i; ++j)
                if (meet(c.body_box[i], c.body_box[j])) c.near[i] = c.near[j] = 1;
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i)
            if (c.near[i]) fit_tree(tables, motion, i);
    }

    // Sets the rows of a step.
    void run() const {
        fit();
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i) {
            if (!c.near[i] && !c.was_near[i]) continue;
            for (int site = sites_before(tables, i); site < sites_before(tables, i + 1); ++site) detect_site(tables, motion, site);
        }
        std::copy(c.near, c.near + loop.bodies, c.was_near);
    }

    // Gives vertices that the solution moves through a triangle, or into a body that they were outside of, a row there, or makes theirs
    // stiffer. True if there are such. room: memory, 4 doubles a node, for where nodes come to and how far at most those of a body move.
    // detected: the rows are those of `run`, so that a vertex that moves less than it was away need not be looked at.
    bool sweep(double* room, bool detected) const {
        fit();
        double *ends = room, *farthest = room + 3 * (int64_t)loop.nodes;
        for (int i = 0; i < loop.bodies; ++i) {
            farthest[i] = 0;
            for (int node = loop.body[i].first; c.near[i] && node < loop.body[i].last; ++node) {
                double* end = ends + 3 * (int64_t)node;
                displacement_of(motion, node, end);
                farthest[i] = std::fmax(farthest[i], std::sqrt(dot3(end, end)));
                for (int k = 0; k < 3; ++k) end[k] += loop.x[3 * (int64_t)node + k];
            }
        }
        Motion ended = motion;
        ended.x = ends;
        ended.predictor = nullptr;
        bool found = false;
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) reduction(|| : found) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i)
            for (int site = sites_before(tables, i); c.near[i] && site < sites_before(tables, i + 1); ++site)
                found = sweep_site(site, ended, detected ? farthest : nullptr) || found;
        // rows of this step, whether found before the solve or here, count in its islands and are looked at again in the next one
        for (int i = 0; i < loop.bodies; ++i) c.near[i] = c.was_near[i] = c.near[i] || c.was_near[i];
        return found;
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
            if (other == body || !c.near[other] || (c.ties.count && c.ties.bound[node] == other + 1) || !meet(box, c.body_box[other])) continue;
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
