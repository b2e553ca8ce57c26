// SPDX-License-Identifier: MIT
// Attachments and springs on a CPU: the start and the end of a step (law: kernels/ties.cuh; input: backends/ties.py).
#pragma once
#include "loop.h"

struct TieRows {
    const Loop& loop;
    Contact& c;
    const Ties& t;

    TieRows(const Loop& loop) : loop(loop), c(*loop.contact), t(loop.contact->ties) {}

    // Sets f_0 and K of the step, before the solve, and takes rows of contact away where an attachment is.
    void prepare() const {
        bind();
        auto block_of = [&](int node) {
            int k = loop.row_start[node];
            while (loop.columns[k] != node) ++k;
            return loop.values + 9 * (int64_t)k;
        };
        for (int i = 0; i < t.count; ++i) {
            c.obstacle[t.first + i] = other_of_tie(t, i);
            if (t.broken[i]) continue;
            if (t.stiffness[i] == 0)
                t.stiffness[i] = t.kappa[i] / compliance_of_tie(t, c.corner, c.weight, c.free, c.dx_dv * c.force_coefficient, i, block_of);
            double e[3];
            gap_of_tie(t, c.obstacles, c.corner, c.weight, loop.x, i, e);
            set_tie(t, i, e);
        }
    }
    void bind() const {
        auto corners = [&](int i, auto f) {
            for (int a = 0; a < CORNERS; ++a) {
                const int node = c.corner[CORNERS * (t.first + i) + a];
                if (binds(t, i, node)) f(node, bound_to(t, i, a));
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
        const int body = t.body[2 * i];
        const bool acts = c.obstacle[t.first + i] >= 0 && c.result[body].status != NOT_FINITE;
        const double* f = c.state[t.first + i].force.traction;
        keep_tie(t, i, acts, f, step);
        if (!acts) return;
        double p[3], sum[6] = {};
        first_point(i, p);
        for (int k = 0; k < 3; ++k) p[k] -= middle[k];
        add_reaction_of_tie(f, p, sum);
        const int other = joins_bodies(t, i) ? t.body[2 * i + 1] : -1;
        for (int k = 0; k < 6; ++k) {
            reaction(body, i)[k] += sum[k];
            if (other >= 0) reaction(other, i)[k] -= sum[k];
        }
    }
    double* reaction(int body, int i) const { return t.reaction + 6 * ((int64_t)t.columns * body + t.column_first + t.table[i]); }
};
