// SPDX-License-Identifier: MIT
// Bodies that are solved as one system, and their rows: vectors are of the whole scene's nodes, of which those of the bodies count.
#pragma once
#include "contact_rows.h"
#include "loop.h"

struct IslandRows {
    Loop& loop;
    Contact& c;
    const int32_t* bodies;
    const int32_t count;
    const bool pairs;                    // rows between bodies count
    Rows rows;
    int32_t* const active;               // its rows that act
    const double* b;
    double* y;

    IslandRows(Loop& loop, int island)
        : loop(loop), c(*loop.contact), bodies(c.island + c.island_start[island]),
          count(c.island_start[island + 1] - c.island_start[island]), pairs(c.pair_first >= 0),
          rows{c, 0, c.active + c.island_rows[island], 0}, active(c.active + c.island_rows[island]), b(loop.b), y(loop.y) {}

    template <class F> void each_entry(F f) const {
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            for (int64_t k = 3 * (int64_t)body.first; k < 3 * (int64_t)body.last; ++k) f(k);
        }
    }
    // f(first, last) of the rows of each body, those with its own vertices
    template <class F> void each_range(F f) const {
        for (int m = 0; m < count; ++m) {
            const int first = c.body_start[bodies[m]], last = c.body_start[bodies[m] + 1];
            f(first, last);
            if (pairs) f(c.pair_first + first, c.pair_first + last);
        }
    }
    template <class F> void each_row(F f) const {
        each_range([&](int first, int last) {
            for (int k = first; k < last; ++k)
                if (!rows.empty(k)) f(k, c.state[k]);
        });
    }

    // Displacements of the points by velocities y.
    void move_points() const {
        each_row([&](int k, RowState& s) {
            double u[3] = {0, 0, 0}, p[3];
            rows.gather(k, y, u);
            rows.at_point(k, c.predictor, p);
            for (int m = 0; m < 3; ++m) s.s[m] = c.dx_dv * (p[m] + u[m]);
        });
    }
};
