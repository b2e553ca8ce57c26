// SPDX-License-Identifier: MIT
// Contacts in the copies of A that factors are made from.
#pragma once
#include "loop.h"

// Stiffness of a row that carried force in the last step. One that slid counts with its normal stiffness alone.
static void lasting_stiffness(const Contact& c, const Rows& rows, int k, double* s) {
    const ContactForce f = lasting_contact(c.friction[k], c.force[k], c.traction + 3 * k);
    contact_stiffness(rows.row(k), f, f.traction, c.dx_dv * c.force_coefficient, s);
}

// Block (i, j) of a body's A, counted from its first one; -1: A has none, or j is of another body.
static int block_between(const Loop& loop, const Body& body, int i, int j) {
    if (i < body.first || i >= body.last) return -1;
    for (int m = loop.row_start[i]; m < loop.row_start[i + 1]; ++m)
        if (loop.columns[m] == j) return m - loop.row_start[body.first];
    return -1;
}

// f(row, its stiffness) of the body's rows against obstacles that carried force in the last step, and of its ties
template <class F> static void each_lasting_row(const Contact& c, const Rows& rows, int index, F f) {
    double s[6];
    each_obstacle_range_of(c, index, [&](int first, int last) {
        for (int k = first; k < last; ++k) {
            if (rows.empty(k) || !(c.force[k] > 0)) continue;
            lasting_stiffness(c, rows, k, s);
            f(k, s);
        }
    });
    for (int i = 0; i < c.ties.count; ++i) {
        if (c.ties.broken[i] || (c.ties.body[2 * i] != index && c.ties.body[2 * i + 1] != index)) continue;
        rows.stiffness(c.ties.first + i, {}, nullptr, c.dx_dv * c.force_coefficient, s);
        f(c.ties.first + i, s);
    }
}

// Adds the stiffness of contacts that carried force in the last step to a copy of a body's blocks, so that a factor made from it knows
// them.
static void add_contacts(const Loop& loop, const Body& body, double* target) {
    const Contact& c = *loop.contact;
    const int index = (int)(&body - loop.body);
    const Rows rows{c, 0, nullptr, 0};
    auto block_of = [&](int i, int j) -> double* {
        const int m = block_between(loop, body, i, j);
        return m < 0 ? nullptr : target + 9 * (int64_t)m;
    };
    each_lasting_row(c, rows, index, [&](int k, const double* s) { rows.add_blocks(k, s, block_of); });
    if (c.pair_first < 0 || !c.near[index]) return;
    auto add = [&](int k) {
        if (rows.empty(k) || !(c.force[k] > 0)) return;
        double s[6];
        lasting_stiffness(c, rows, k, s);
        rows.add_blocks(k, s, block_of);
    };
    auto add_all = [&](int first, int last) {
        for (int k = first; k < last; ++k) add(k);
    };
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

// Notes what a copy of a body's matrix would know of contacts in this step.
static void note_touches(const Loop& loop, Body& body) {
    Correction& t = body.correction;
    if (!t.touches) return;
    const Contact& c = *loop.contact;
    const int index = (int)(&body - loop.body);
    const Rows rows{c, 0, nullptr, 0};
    auto put = [&](int node, int other) {
        KnownContact& touch = t.touch[t.touched % t.touches];
        if (t.touched >= t.touches) t.touch_lost = touch.step;
        ++t.touched;
        touch = {loop.rings.step, {}, node, other};
        return touch.block;
    };
    auto block_of = [&](int i, int j) -> double* {
        return i > j || block_between(loop, body, i, j) < 0 ? nullptr : put(i - body.first, j - body.first);
    };
    bool others = c.pair_first >= 0 && (c.near[index] & 1);
    each_lasting_row(c, rows, index, [&](int k, const double* s) {
        if (is_pair(c, k)) others = true;
        else rows.add_blocks(k, s, block_of);
    });
    if (c.own.near.start)
        each_pair_range_of(c, index, [&](int first, int last) {
            for (int k = first; k < last; ++k) {
                if (c.obstacle[k] != index || !(c.force[k] > 0)) continue;
                double s[6];
                lasting_stiffness(c, rows, k, s);
                rows.add_blocks(k, s, block_of);
            }
        });
    if (others) put(-1, -1);
}

// Tells the factor's correction which contacts A has. rows: those of the body.
static void tell_correction(const Rows& rows, Body& body) {
    Correction& t = body.correction;
    if (!t.touches) return;
    t.in_contact = 1;
    t.links_now = 0;
    std::fill(t.touch_now, t.touch_now + 9 * (int64_t)t.nodes, 0.0);
    auto block_of = [&](int i, int j) -> double* {
        if (i == j) return t.touch_now + 9 * (int64_t)(i - body.first);
        if (i > j) return nullptr;
        if (t.links_now == t.touches) t.in_contact = 0, t.links_now = 0;  // too many to correct the factor for
        KnownContact& link = t.link_now[t.links_now++];
        link = {0, {}, i - body.first, j - body.first};
        return link.block;
    };
    for (int k = 0; k < rows.actives; ++k) rows.add_blocks(rows.active[k], rows.c.state[rows.active[k]].stiffness, block_of);
}
