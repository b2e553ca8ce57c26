// SPDX-License-Identifier: MIT
// What two bodies exert on each other, from the sums over the rows of both; for the loops of both devices.
#pragma once
#include <cstdint>
#include <vector>

#include "reaction.h"

struct Span {
    const PairSum* first;
    int count;
};

// Appends what body `i` exerts on sum.other, and the contrary. back: of the rows of that body against i, or null.
static void add_pair(std::vector<Reaction>& found, int64_t step, int i, const PairSum& sum, const PairSum* back) {
    Reaction r{step, sum.other, i, ON_OBJECT, {}, {}, {}};
    for (int m = 0; m < 3; ++m) {
        r.force[m] = (back ? back->force[m] : 0) - sum.force[m];
        r.point[m] = (sum.point[m] + (back ? back->point[m] : 0)) / (sum.normal + (back ? back->normal : 0));
    }
    for (int m = 0; m < 3; ++m) {
        const int a = (m + 1) % 3, b = (m + 2) % 3;
        r.torque[m] = (back ? back->torque[m] : 0) - sum.torque[m] - (r.point[a] * r.force[b] - r.point[b] * r.force[a]);
    }
    found.push_back(r);
    r.body = sum.other;
    r.number = i;
    for (int m = 0; m < 3; ++m) {
        r.force[m] = -r.force[m];
        r.torque[m] = -r.torque[m];
    }
    found.push_back(r);
}

// Appends the reactions of all bodies that touch each other. sums_of(i): Span of a body's sums
template <class Of> static void add_pairs(int bodies, int64_t step, std::vector<Reaction>& found, Of sums_of) {
    for (int i = 0; i < bodies; ++i) {
        const Span own = sums_of(i);
        for (int at = 0; at < own.count; ++at) {
            const int other = own.first[at].other;
            const Span theirs = sums_of(other);
            const PairSum* back = nullptr;
            for (int b = 0; b < theirs.count; ++b)
                if (theirs.first[b].other == i) back = theirs.first + b;
            if (!back || i < other) add_pair(found, step, i, own.first[at], back);
        }
    }
}
