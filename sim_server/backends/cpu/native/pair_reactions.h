// SPDX-License-Identifier: MIT
// What bodies exert on each other in a step, from the rows between them.
#pragma once
#include <vector>

#include "loop.h"
#include "pair_wrenches.h"

// Adds the force of row k, of a body against `other`, to the sums from `first` on.
static void add_pair_row(const Contact& c, const double* x, int k, int other, std::vector<PairSum>& sums, size_t first) {
    size_t at = first;
    while (at < sums.size() && sums[at].other != other) ++at;
    if (at == sums.size()) sums.push_back({other, 0, {}, {}, {}});
    PairSum& sum = sums[at];
    double p[3] = {}, f[3];
    for (int a = 0; a < CORNERS; ++a) {
        const double weight = c.weight[CORNERS * k + a];
        for (int m = 0; m < 3 && weight > 0; ++m) p[m] += weight * x[3 * (int64_t)c.corner[CORNERS * k + a] + m];
    }
    sum.normal += c.force[k];
    for (int m = 0; m < 3; ++m) {
        f[m] = c.force[k] * c.normal[3 * k + m] + c.traction[3 * k + m];
        sum.force[m] += f[m];
        sum.point[m] += c.force[k] * p[m];
    }
    sum.torque[0] += p[1] * f[2] - p[2] * f[1];
    sum.torque[1] += p[2] * f[0] - p[0] * f[2];
    sum.torque[2] += p[0] * f[1] - p[1] * f[0];
}

// Appends the reactions of all bodies that touch each other, after a step. A body's contact with itself is none.
static void add_pair_reactions(const Loop& loop, int64_t step, std::vector<Reaction>& found) {
    const Contact& c = *loop.contact;
    static thread_local std::vector<PairSum> sums;
    static thread_local std::vector<size_t> first;
    sums.clear();
    first.clear();
    for (int i = 0; i < loop.bodies; ++i) {
        first.push_back(sums.size());
        each_pair_range_of(c, i, [&](int begin, int end) {
            for (int k = begin; c.near[i] && k < end; ++k)
                if (c.obstacle[k] >= 0 && c.obstacle[k] != i && c.force[k] > 0) add_pair_row(c, loop.x, k, c.obstacle[k], sums, first[i]);
        });
    }
    first.push_back(sums.size());
    add_pairs(loop.bodies, step, found, [&](int i) { return Span{sums.data() + first[i], (int)(first[i + 1] - first[i])}; });
}
