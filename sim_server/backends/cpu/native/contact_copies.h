// SPDX-License-Identifier: MIT
// Contacts in the copies of A that factors are made from.
#pragma once
#include "loop.h"

// Stiffness of a row that carried force in the last step. One that slid counts with its normal stiffness alone.
static void lasting_stiffness(const Contact& c, const Rows& rows, int k, double* s) {
    const ContactForce f = lasting_contact(c.friction[k], c.force[k], c.traction + 3 * k);
    contact_stiffness(rows.row(k), f, c.dx_dv * c.force_coefficient, s);
}

// Adds the stiffness of contacts that carried force in the last step to a copy of a body's blocks, so that a factor made from it knows
// them.
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
        double s[6];
        lasting_stiffness(c, rows, k, s);
        rows.add_blocks(k, s, block_of);
    };
    auto add_all = [&](int first, int last) {
        for (int k = first; k < last; ++k) add(k);
    };
    each_obstacle_range_of(c, index, add_all);
    for (int i = 0; i < c.ties.count; ++i) {
        if (c.ties.broken[i] || (c.ties.body[2 * i] != index && c.ties.body[2 * i + 1] != index)) continue;
        double s[6];
        rows.stiffness(c.ties.first + i, {}, c.dx_dv * c.force_coefficient, s);
        rows.add_blocks(c.ties.first + i, s, block_of);
    }
    if (c.pair_first < 0 || !c.near[index]) return;
    auto add_shared = [&](int first, int last) {
        for (int k = first; k < last; ++k)
            if (c.obstacle[k] == index) add(k);
    };
    for (int i = 0; i < loop.bodies; ++i) {
        if (!c.near[i]) continue;
        if (i == index) each_pair_range_of(c, i, add_all);
        else each_pair_range_of(c, i, add_shared);
    }
}

// Upper triangle of w^2 R^T S R, the part of a row against an obstacle on its node's own block. Returns the node within the body.
static int own_block(const Contact& c, const Body& body, int k, const double* s, double* out) {
    const int node = c.corner[CORNERS * k];
    const double *R = c.rotation + 9 * (int64_t)node, w = c.weight[CORNERS * k];
    double SR[9];
    const double S[9] = {s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5]};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) SR[3 * i + j] = S[3 * i] * R[j] + S[3 * i + 1] * R[3 + j] + S[3 * i + 2] * R[6 + j];
    int m = 0;
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j) out[m++] = w * w * (R[i] * SR[j] + R[3 + i] * SR[3 + j] + R[6 + i] * SR[6 + j]);
    return node - body.first;
}

// Notes what a copy of a body's matrix would know of contacts in this step.
static void note_touches(const Loop& loop, Body& body) {
    Correction& t = body.correction;
    if (!t.touches) return;
    const Contact& c = *loop.contact;
    const int index = (int)(&body - loop.body);
    const Rows rows{c, 0, nullptr, 0};
    auto put = [&](int node) -> KnownContact& {
        KnownContact& touch = t.touch[t.touched % t.touches];
        if (t.touched >= t.touches) t.touch_lost = touch.step;
        ++t.touched;
        touch.step = loop.rings.step;
        touch.node = node;
        return touch;
    };
    for (int k = c.body_start[index]; k < c.body_start[index + 1]; ++k) {
        if (rows.empty(k) || !(c.force[k] > 0)) continue;
        double s[6], block[6];
        lasting_stiffness(c, rows, k, s);
        const int node = own_block(c, body, k, s, block);
        std::copy(block, block + 6, put(node).block);
    }
    if (c.pair_first >= 0 && c.near[index]) put(-1);
}
