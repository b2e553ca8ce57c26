// SPDX-License-Identifier: MIT
// Which bodies are solved as one system.
#pragma once
#include <algorithm>
#include <cmath>

#include "loop.h"

// True if a body's step is made, by a scheme other than backward Euler (euler_form.h).
static bool is_made(const Loop& loop, int i) { return loop.euler && !loop.euler->takes[i]; }

// Has bodies that a sweep has given rows take backward Euler. True if a step was made.
static bool unmake_touched(Loop& loop) {
    bool any = false;
    for (int i = 0; i < loop.bodies; ++i) {
        if (!loop.contact->touched[i] || !is_made(loop, i)) continue;
        loop.euler->takes[i] = 1;
        any = true;
    }
    return any;
}

// Each body by itself.
static void single_islands(Loop& loop) {
    Contact& c = *loop.contact;
    c.islands = loop.bodies;
    for (int i = 0; i <= loop.bodies; ++i) c.island_start[i] = i;
    for (int i = 0, rows = 0; i < loop.bodies; ++i) {
        c.island[i] = i;
        c.island_rows[i] = rows;
        each_range_of(c, i, [&](int first, int last) { rows += last - first; });
    }
}

// Groups the bodies that have rows with each other, each group's by number. Bodies whose forces are NaN are left alone, and so are those
// whose step is made.
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
        const int size = 3 * (body.last - body.first);
        return std::isfinite(dot(size, loop.b + at, loop.b + at)) && std::isfinite(dot(size, loop.x + at, loop.x + at));
    };
    for (int i = 0; (c.pair_first >= 0 || c.ties.count) && i < loop.bodies; ++i) well[i] = !is_made(loop, i) && finite(i);
    for (int i = 0; c.pair_first >= 0 && i < loop.bodies; ++i) {
        if (!c.near[i] || is_made(loop, i)) continue;
        each_pair_range_of(c, i, [&](int first, int last) {
            for (int k = first; k < last; ++k) {
                const int other = c.obstacle[k];
                if (other < 0) continue;
                if (!well[i] || !well[other]) { c.obstacle[k] = -1; continue; }
                const int a = root(i), b = root(other);
                parent[std::max(a, b)] = std::min(a, b);
            }
        });
    }
    for (int i = 0; i < c.ties.count; ++i) {
        const int32_t* body = c.ties.body + 2 * i;
        const bool two = body[1] >= 0;
        if (c.obstacle[c.ties.first + i] < 0) continue;
        if (!well[body[0]] || (two && !well[body[1]])) { c.obstacle[c.ties.first + i] = -1; continue; }
        const int a = root(body[0]), b = two ? root(body[1]) : a;
        parent[std::max(a, b)] = std::min(a, b);
    }
    c.islands = 0;
    int bodies = 0, rows = 0;
    for (int i = 0; i < loop.bodies; ++i) {
        if (root(i) != i || is_made(loop, i)) continue;
        c.island_start[c.islands] = bodies;
        c.island_rows[c.islands++] = rows;
        for (int j = i; j < loop.bodies; ++j) {
            if (root(j) != i) continue;
            c.island[bodies++] = j;
            each_range_of(c, j, [&](int first, int last) { rows += last - first; });
        }
    }
    c.island_start[c.islands] = bodies;
}
