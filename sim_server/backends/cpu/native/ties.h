// SPDX-License-Identifier: MIT
// Attachments and springs (input: backends/ties.py): rows among those of contact whose force on their first side is linear in a step,
//     f = f_0 - K s,   s the displacement in the step of the first point relative to the second.
// A spring of stiffness k, length l and rest length l_0 pulls by k (l - l_0) along its direction at the start of the step; K = k along
// it and k (1 - l_0 / l), if above 0, across. An attachment has K = k I and carries its force from step to step (augmented Lagrangian:
// Nocedal and Wright, Numerical Optimization, section 17.3), f = f of the last step - k (gap at the end of this step): at rest there is
// no gap. k is kappa / h^2 over the sum of w_a^2 / A_aa of its corners, from the first step.
#pragma once
#include <cmath>

#include "loop.h"

struct TieRows {
    const Loop& loop;
    Contact& c;
    const Ties& t;
    const Rows rows;

    TieRows(const Loop& loop) : loop(loop), c(*loop.contact), t(loop.contact->ties), rows{c, 0, nullptr, 0} {}

    template <class F> void each(F f) const {
        for (int i = 0; i < t.count; ++i) f(i, t.first + i);
    }

    // Sets f_0 and K of the step, before the solve, and takes rows of contact away where an attachment is.
    void prepare() const {
        bind();
        each([&](int i, int row) {
            c.obstacle[row] = t.broken[i] ? -1 : t.body[2 * i + 1] >= 0 ? t.body[2 * i + 1] : t.body[2 * i];
            if (t.broken[i]) return;
            if (t.stiffness[i] == 0) t.stiffness[i] = t.kappa[i] / compliance(row);
            double e[3], end[3];
            rows.at_point(row, loop.x, e);  // first point minus second
            if (t.obstacle[i] >= 0) {
                world_point(c.obstacles.end + 7 * t.obstacle[i], t.point + 3 * i, end);
                for (int k = 0; k < 3; ++k) e[k] -= end[k];
            }
            if (t.kappa[i] > 0) attach(i, e);
            else spring(i, e);
        });
    }
    void bind() const {
        auto corners = [&](int i, auto f) {
            for (int a = 0; a < CORNERS; ++a) {
                const int node = c.corner[CORNERS * (t.first + i) + a], other = t.body[2 * i + (a == 0)];
                if (node >= 0 && t.kappa[i] > 0 && t.body[2 * i + 1] >= 0) f(node, other);
            }
        };
        for (int i = 0; i < t.count; ++i) corners(i, [&](int node, int) { t.bound[node] = 0; });
        for (int i = 0; i < t.count; ++i)
            if (!t.broken[i])
                corners(i, [&](int node, int other) {
                    t.bound[node] = other + 1;
                    const int site = c.pair_first >= 0 ? c.node_site[node] : -1;
                    for (int row = c.pair_first + 2 * site; site >= 0 && row < c.pair_first + 2 * site + 2; ++row)
                        if (c.obstacle[row] == other) c.obstacle[row] = -1;
                });
        auto bound = [&](int node, int other) { return t.bound[node] == other + 1; };
        for (int row = c.edge_start ? c.edge_start[0] : 0; c.edge_start && row < c.edge_start[loop.bodies]; ++row) {
            const int32_t *node = c.corner + CORNERS * row, other = c.obstacle[row], body = c.row_body[row];
            if (other < 0) continue;
            if (bound(node[0], other) || bound(node[1], other) || bound(node[2], body) || bound(node[3], body)) c.obstacle[row] = -1;
        }
    }
    // h^2 times the sum of w_a^2 / A_aa of the corners that may move [1 / (N/m)]
    double compliance(int row) const {
        double sum = 0;
        rows.each_corner(row, [&](int node, double weight) {
            int k = loop.row_start[node];
            while (loop.columns[k] != node) ++k;
            const double* A = loop.values + 9 * (int64_t)k;
            sum += 3 * weight * weight / (A[0] + A[4] + A[8]);
        });
        return sum > 0 ? c.dx_dv * c.force_coefficient * sum : 1;
    }
    void attach(int i, const double* e) const {
        const double k = t.stiffness[i], K[6] = {k, 0, 0, k, 0, k};
        for (int m = 0; m < 6; ++m) t.slope[6 * i + m] = K[m];
        for (int m = 0; m < 3; ++m) t.start_force[3 * i + m] = t.force[3 * i + m] - k * e[m];
    }
    void spring(int i, const double* e) const {
        const double length = std::sqrt(dot3(e, e)), k = t.stiffness[i], pull = k * (length - t.rest[i]);
        const double across = pull > 0 ? pull / length : 0;
        int n = 0;
        for (int l = 0; l < 3; ++l) {
            const double along = length > 0 ? e[l] / length : 0;
            t.start_force[3 * i + l] = -pull * along;
            for (int m = l; m < 3; ++m)
                t.slope[6 * i + n++] = (l == m ? across : 0) + (k - across) * along * (length > 0 ? e[m] / length : 0);
        }
    }

    // Keeps the forces of the step, breaks what they are too much for, and sums forces and torques by attachment or spring: what each
    // body exerts. Torques are about the mean of its first points at the end of the step.
    void finish(int64_t step) const {
        for (int i = 0; i < loop.bodies; ++i) {
            double* own = t.reaction + 6 * ((int64_t)t.columns * i + t.column_first);
            std::fill(own, own + 6 * t.tables, 0.0);
        }
        for (int i = 0; i < t.count;) {
            int last = i;
            double middle[3] = {0, 0, 0}, p[3];
            while (last < t.count && t.table[t.order[last]] == t.table[t.order[i]]) {
                first_point(t.order[last++], p);
                for (int k = 0; k < 3; ++k) middle[k] += p[k];
            }
            for (int k = 0; k < 3; ++k) middle[k] /= last - i;
            for (; i < last; ++i) keep(t.order[i], middle, step);
        }
    }
    // First corner at the end of the step.
    void first_point(int i, double* p) const {
        const int64_t node = c.corner[CORNERS * (t.first + i)];
        double u[3];
        rotated(c.rotation + 9 * node, loop.y + 3 * node, u);
        for (int k = 0; k < 3; ++k) p[k] = loop.x[3 * node + k] + c.dx_dv * (c.predictor[3 * node + k] + u[k]);
    }
    void keep(int i, const double* middle, int64_t step) const {
        const int row = t.first + i, other = t.body[2 * i + 1];
        const bool acts = c.obstacle[row] >= 0 && c.result[t.body[2 * i]].status != NOT_FINITE;
        const double* f = c.state[row].force.traction;
        double p[3], arm[3];
        for (int k = 0; k < 3; ++k) t.force[3 * i + k] = acts ? f[k] : 0;
        if (!acts) return;
        first_point(i, p);
        for (int k = 0; k < 3; ++k) arm[k] = p[k] - middle[k];
        for (int side = 0; side < (other >= 0 && other != t.body[2 * i] ? 2 : 1); ++side) {
            double* sum = t.reaction + 6 * ((int64_t)t.columns * t.body[2 * i + side] + t.column_first + t.table[i]);
            const double sign = side ? 1 : -1;
            for (int k = 0; k < 3; ++k) {
                const int a = (k + 1) % 3, b = (k + 2) % 3;
                sum[k] += sign * f[k];
                sum[3 + k] += sign * (arm[a] * f[b] - arm[b] * f[a]);
            }
        }
        if (std::sqrt(dot3(f, f)) > t.breaking[i]) t.broken[i] = (int32_t)step;
    }
};
