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
                                   c.thickness, c.force, c.traction, c.pair_first, c.site_body, c.node_site, c.triangle, c.tree_start,
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
    // stiffer. True if there are such. ends: (nodes, 3) memory for where nodes come to.
    bool sweep(double* ends) const {
        fit();
        for (int i = 0; i < loop.bodies; ++i)
            for (int node = loop.body[i].first; c.near[i] && node < loop.body[i].last; ++node) {
                double* end = ends + 3 * (int64_t)node;
                displacement_of(motion, node, end);
                for (int k = 0; k < 3; ++k) end[k] += loop.x[3 * (int64_t)node + k];
            }
        Motion ended = motion;
        ended.x = ends;
        ended.predictor = nullptr;
        bool found = false;
        for (int i = 0; i < loop.bodies; ++i)
            for (int site = sites_before(tables, i); c.near[i] && site < sites_before(tables, i + 1); ++site) found = sweep_site(site, ended) || found;
        // rows of this step, whether found before the solve or here, count in its islands and are looked at again in the next one
        for (int i = 0; i < loop.bodies; ++i) c.near[i] = c.was_near[i] = c.near[i] || c.was_near[i];
        return found;
    }
    bool sweep_site(int site, const Motion& ended) const {
        const int node = node_of_site(tables, site), body = c.site_body[site];
        if (c.free[node] == 0) return false;
        const Box box = box_of(motion, node, thickness_of(tables, body));
        bool found = false;
        for (int other = 0; other < loop.bodies; ++other) {
            if (other == body || !c.near[other] || !meet(box, c.body_box[other])) continue;
            const double thickness = 0.5 * (thickness_of(tables, body) + thickness_of(tables, other));
            Meeting t;
            if (passage_of(tables, motion, ended, node, other, thickness, t) == STAYS_OUT) continue;
            take_row(c.pair_first + 2 * site, site, t);
            c.touched[body] = c.touched[other] = 1;
            found = true;
        }
        return found;
    }
    void take_row(int pair, int site, const Meeting& t) const {
        const int k = row_for(c, pair, t.other);
        const bool same = c.obstacle[k] == t.other;
        RowState& state = c.state[k];
        if (same && dot3(c.normal + 3 * k, t.touch.normal) > SAME_PLANE) { state.hardening *= HARDER; return; }
        put_row(tables, motion, k, site, t);
        take_anew(state);
    }
};
