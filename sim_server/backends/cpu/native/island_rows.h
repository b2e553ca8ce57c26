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
    Rows rows;
    int32_t *const active, *const used;  // its rows that act, and that are not empty
    int used_count = 0;
    const double* b;
    double* y;

    IslandRows(Loop& loop, int island)
        : loop(loop), c(*loop.contact), bodies(c.island + c.island_start[island]),
          count(c.island_start[island + 1] - c.island_start[island]), rows{c, 0, c.active + c.island_rows[island], 0},
          active(c.active + c.island_rows[island]), used(c.used + c.island_rows[island]), b(loop.b), y(loop.y) {
        list_rows();
    }

    template <class F> void each_entry(F f) const {
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            for (int64_t k = 3 * (int64_t)body.first; k < 3 * (int64_t)body.last; ++k) f(k);
        }
    }
    // f(first, last) of the rows of each body, each sort
    template <class F> void each_range(F f) const {
        for (int m = 0; m < count; ++m) each_range_of(c, bodies[m], f);
    }
    // Takes up which rows are not empty.
    void list_rows() {
        used_count = 0;
        each_range([&](int first, int last) {
            for (int k = first; k < last; ++k)
                if (!rows.empty(k)) used[used_count++] = k;
        });
    }
    template <class F> void each_row(F f) const {
        for (int m = 0; m < used_count; ++m) f(used[m], c.state[used[m]]);
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

    // Of first_entered.
    auto entry() const {
        return [&t = c.obstacles](int obstacle, const double* from, const double* to, double* begin, double* end) {
            return entry_of_way(t, obstacle, 0, from, to, begin, end);
        };
    }
};
