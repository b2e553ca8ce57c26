// SPDX-License-Identifier: MIT
// Contacts in the copies of A that factors are made from.
#pragma once
#include "loop.h"

// Adds the stiffness of contacts that carried force in the last step to a copy of a body's blocks, so that a factor made from it knows
// them. A row that slid counts with its normal stiffness alone.
static void add_contacts(const Loop& loop, const Body& body, double* target) {
    const Contact& c = *loop.contact;
    const int index = (int)(&body - loop.body), begin = loop.row_start[body.first];
    const Rows rows{c, 0, nullptr, 0};
    auto block_of = [&](int i, int j) -> double* {
        if (i < body.first || i >= body.last) return nullptr;
        for (int m = loop.row_start[i]; m < loop.row_start[i + 1]; ++m)
            if (loop.columns[m] == j) return target + 9 * (int64_t)(m - begin);
        return nullptr;
    };
    auto add = [&](int k) {
        if (rows.empty(k) || !(c.force[k] > 0)) return;
        const ContactForce f = lasting_contact(c.friction[k], c.force[k], c.traction + 3 * k);
        double s[6];
        c.state[k].hardening = 1;
        contact_stiffness(rows.row(k), f, c.dx_dv * c.force_coefficient, s);
        rows.add_blocks(k, s, block_of);
    };
    for (int k = c.body_start[index]; k < c.body_start[index + 1]; ++k) add(k);
    if (c.pair_first < 0 || !c.near[index]) return;
    for (int i = 0; i < loop.bodies; ++i)
        for (int k = c.pair_first + c.body_start[i]; c.near[i] && k < c.pair_first + c.body_start[i + 1]; ++k)
            if (i == index || c.obstacle[k] == index) add(k);
}
