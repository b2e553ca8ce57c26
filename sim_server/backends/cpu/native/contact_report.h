// SPDX-License-Identifier: MIT
// The end of a step of an island in contact: forces are kept for the next one, and each body has its report.
#pragma once
#include <algorithm>
#include <cmath>

#include "island_rows.h"

struct ContactEnd : IslandRows {
    const SolveResult& result;
    const ContactReport& report;  // of the island

    ContactEnd(const IslandRows& of, const SolveResult& result, const ContactReport& report) : IslandRows(of), result(result), report(report) {}

    // Keeps the forces for the next step, and reports on each body.
    void finish() const {
        const bool well = result.status != NOT_FINITE;
        for (int m = 0; m < count; ++m) {
            ContactReport& report = c.report[bodies[m]];
            const int clipped = report.clipped;
            report = this->report;
            report.clipped = clipped;
            double* reaction = c.reaction + 6 * (int64_t)c.obstacle_count * bodies[m];
            std::fill(reaction, reaction + 6 * c.obstacle_count, 0.0);
        }
        each_range([&](int first, int last) {
            for (int k = first; k < last; ++k)
                if (is_tie(c, k)) count_work(k, well && !rows.empty(k));
                else keep(k, well && !rows.empty(k) && c.state[k].force.normal > 0);
        });
        for (int m = 0; m < count; ++m) {
            ContactReport& report = c.report[bodies[m]];
            if (!report.contacts && !report.passes) report.residual = NAN;
            const bool balanced = c.result[bodies[m]].status != CONTACT && !report.clipped;  // else the forces are more than what acted
            if (!balanced && report.work < 0) report.work = 0;
        }
    }

    void keep(int k, bool closed) const {
        const RowState& s = c.state[k];
        double f[3];
        const double before = c.force[k];
        c.force[k] = closed ? s.force.normal : 0;
        c.hardening[k] = lasting_hardening(c.hardening[k], before, c.force[k], c.stiffness[k], c.thickness[k]);
        for (int m = 0; m < 3; ++m) {
            c.traction[3 * k + m] = closed ? s.force.traction[m] : 0;
            f[m] = c.force[k] * c.normal[3 * k + m] + c.traction[3 * k + m];
        }
        if (!closed) return;
        const int body = body_of_row(c, k, false);
        ++c.report[body].contacts;
        add_work(k, f);
        if (is_pair(c, k)) c.report[c.obstacle[k]].contacts += c.obstacle[k] != body;
        else react(k, f, c.reaction + 6 * ((int64_t)c.obstacle_count * body + c.obstacle[k]));
    }
    void count_work(int k, bool acts) const {
        if (acts) add_work(k, c.state[k].force.traction);
    }
    // Adds the work of a row's force to the reports of its bodies; at a held node it acts on what holds the node.
    void add_work(int k, const double* f) const {
        double displacement[2][3] = {};
        for (int a = 0; a < CORNERS; ++a) {
            const int node = c.corner[CORNERS * k + a];
            if (node < 0 || c.free[node] == 0) continue;
            double u[3];
            rotated(c.rotation + 9 * (int64_t)node, y + 3 * (int64_t)node, u);
            for (int m = 0; m < 3; ++m)
                displacement[is_other_side(c, k, a)][m] += c.weight[CORNERS * k + a] * c.dx_dv * (c.predictor[3 * (int64_t)node + m] + u[m]);
        }
        c.report[body_of_row(c, k, false)].work += dot3(f, displacement[0]);
        if (is_pair(c, k)) c.report[c.obstacle[k]].work += dot3(f, displacement[1]);
    }

    // Force and torque of row k on its obstacle.
    void react(int k, const double* f, double* sum) const {
        double p[3], arm[3];
        rows.at_point(k, loop.x, p);
        for (int m = 0; m < 3; ++m) {
            arm[m] = p[m] + c.state[k].s[m] - c.obstacles.end[7 * c.obstacle[k] + m];
            sum[m] -= f[m];
        }
        sum[3] -= arm[1] * f[2] - arm[2] * f[1];
        sum[4] -= arm[2] * f[0] - arm[0] * f[2];
        sum[5] -= arm[0] * f[1] - arm[1] * f[0];
    }
};
