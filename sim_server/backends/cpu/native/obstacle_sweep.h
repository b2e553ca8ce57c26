// SPDX-License-Identifier: MIT
// The sweep of an island's paths past obstacles, after its passes: points that enter get rows there, and what is still left is held back.
#pragma once
#include <algorithm>
#include <cmath>

#include "island_rows.h"

struct ObstacleSweep : IslandRows {
    ObstacleSweep(const IslandRows& of) : IslandRows(of) {}

    // f(k) of the first row against obstacles of each point
    template <class F> void each_site(F f) const {
        for (int m = 0; m < count; ++m)
            for (int k = c.body_start[bodies[m]]; k < c.body_start[bodies[m] + 1]; k += 2) f(k);
    }

    // Point of a site, at the start of the step and moved by y. Both rows of a node have the same.
    void path(int k, double* from, double* to) const {
        double u[3] = {0, 0, 0}, p[3];
        rows.at_point(k, loop.x, from);
        rows.at_point(k, c.predictor, p);
        rows.gather(k, y, u);
        for (int m = 0; m < 3; ++m) to[m] = from[m] + c.dx_dv * (p[m] + u[m]);
    }

    // Gives row k the plane at which the point of its path enters the obstacle.
    void set_plane(int k, int obstacle, const double* from, const double* begin, const double* end, double t) const {
        c.gap[k] = plane_on_way(c.obstacles, obstacle, from, begin, end, t, c.normal + 3 * k, c.drift + 3 * k);
        c.obstacle[k] = obstacle;
        c.entry[k] = t;
    }

    // The box of a body's points, at the start of the step and moved by y: middle and radius of the spheres around both.
    struct Ways {
        double from[3], to[3], from_radius, to_radius;
    };
    Ways ways(int body) const {
        double low[6], high[6];
        for (int m = 0; m < 6; ++m) { low[m] = INFINITY; high[m] = -INFINITY; }
        for (int k = c.body_start[body]; k < c.body_start[body + 1]; k += 2) {
            double p[6];
            path(k, p, p + 3);
            for (int m = 0; m < 6; ++m) { low[m] = std::min(low[m], p[m]); high[m] = std::max(high[m], p[m]); }
        }
        Ways w;
        double half[6];
        for (int m = 0; m < 6; ++m) {
            (m < 3 ? w.from[m] : w.to[m - 3]) = 0.5 * (low[m] + high[m]);
            half[m] = 0.5 * (high[m] - low[m]);
        }
        w.from_radius = std::sqrt(dot3(half, half));
        w.to_radius = std::sqrt(dot3(half + 3, half + 3));
        return w;
    }

    // True if no point of the body can come to the obstacle: the paths of any two points differ by both radii at most.
    bool far_away(int obstacle, const Ways& w) const {
        double begin[3], end[3], n[3];
        local_point(c.obstacles.begin + 7 * obstacle, w.from, begin);
        local_point(c.obstacles.end + 7 * obstacle, w.to, end);
        const double distance = distance_to(c.obstacles, obstacle, begin, n);
        for (int m = 0; m < 3; ++m) end[m] -= begin[m];
        return distance > std::sqrt(dot3(end, end)) + 2 * w.from_radius + w.to_radius;
    }

    // Gives points that y moves into an obstacle a row there. Rows come in pairs, of one point each. Returns whether there are such.
    bool sweep() const {
        bool found = false;
        for (int m = 0; m < count && c.obstacle_count > 0; ++m) {
            const Ways w = ways(bodies[m]);
            for (int o = 0; o < c.obstacle_count; ++o)
                if (!far_away(o, w)) found = sweep(bodies[m], o) || found;
        }
        return found;
    }
    bool sweep(int body, int obstacle) const {
        bool found = false;
        for (int k = c.body_start[body]; k < c.body_start[body + 1]; k += 2) {
            if (c.free[c.corner[CORNERS * k]] == 0) continue;  // of a frozen body
            double from[3], to[3], begin[3], end[3];
            path(k, from, to);
            if (entry_of_way(c.obstacles, obstacle, 0, from, to, begin, end) > 1) continue;
            const double near = entry_time(c.obstacles, obstacle, begin, end, c.thickness[k]);
            take_row(k, obstacle, from, begin, end, near <= 1 ? near : 0);
            found = true;
        }
        return found;
    }

    // One of a pair's rows: the obstacle's own, an empty one, or the one that carries less.
    void take_row(int pair, int obstacle, const double* from, const double* begin, const double* end, double t) const {
        const int k = row_for(c, pair, obstacle);
        const bool same = c.obstacle[k] == obstacle;
        const double *n = c.normal + 3 * k, normal[3] = {n[0], n[1], n[2]}, gap = c.gap[k];
        set_plane(k, obstacle, from, begin, end, t);
        if (same && dot3(normal, c.normal + 3 * k) > SAME_PLANE && std::fabs(gap - c.gap[k]) < 0.1 * c.thickness[k]) {
            c.hardening[k] = std::min(HARDER * c.hardening[k], HARDEST);
            return;
        }
        take_anew(c.state[k]);
        c.hardening[k] = 1;
        std::fill(c.traction + 3 * k, c.traction + 3 * k + 3, 0.0);
    }

    // Sets points that y moves into an obstacle back, to a part of the way.
    void clip() const {
        each_site([&](int k) {
            const int node = c.corner[CORNERS * k];
            double from[3], to[3], back[3], dv[3];
            if (c.free[node] == 0) return;
            path(k, from, to);
            if (!place_in_front(c.obstacles, c.obstacle_count, from, to, back, entry())) return;
            for (int m = 0; m < 3; ++m) dv[m] = (back[m] - from[m]) / c.dx_dv - c.predictor[3 * (int64_t)node + m];
            rotated_back(c.rotation + 9 * (int64_t)node, dv, y + 3 * (int64_t)node);
        });
    }
};
