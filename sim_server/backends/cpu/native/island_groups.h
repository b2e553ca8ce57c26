// SPDX-License-Identifier: MIT
// Which bodies are solved as one system.
#pragma once
#include <algorithm>
#include <cmath>

#include "loop.h"

// Groups the bodies that have rows with each other, each group's by number. Bodies whose forces are NaN are left alone.
static void find_islands(Loop& loop) {
    Contact& c = *loop.contact;
    int32_t *parent = c.mode, *well = c.island_rows;  // free until an island is solved; until islands are numbered
    for (int i = 0; i < loop.bodies; ++i) parent[i] = i;
    auto root = [&](int i) {
        while (parent[i] != i) i = parent[i] = parent[parent[i]];
        return i;
    };
    auto finite = [&](int i) {
        const Body& body = loop.body[i];
        const int64_t at = 3 * (int64_t)body.first;
        return std::isfinite(dot(3 * (body.last - body.first), loop.b + at, loop.b + at));
    };
    for (int i = 0; c.pair_first >= 0 && i < loop.bodies; ++i) well[i] = finite(i);
    for (int i = 0; c.pair_first >= 0 && i < loop.bodies; ++i) {
        if (!c.near[i]) continue;
        for (int k = c.pair_first + c.body_start[i]; k < c.pair_first + c.body_start[i + 1]; ++k) {
            const int other = c.obstacle[k];
            if (other < 0) continue;
            if (!well[i] || !well[other]) { c.obstacle[k] = -1; continue; }
            const int a = root(i), b = root(other);
            parent[std::max(a, b)] = std::min(a, b);
        }
    }
    c.islands = 0;
    int bodies = 0, rows = 0;
    for (int i = 0; i < loop.bodies; ++i) {
        if (root(i) != i) continue;
        c.island_start[c.islands] = bodies;
        c.island_rows[c.islands++] = rows;
        for (int j = i; j < loop.bodies; ++j) {
            if (root(j) != i) continue;
            c.island[bodies++] = j;
            rows += (c.pair_first >= 0 ? 2 : 1) * (c.body_start[j + 1] - c.body_start[j]);
        }
    }
    c.island_start[c.islands] = bodies;
}
