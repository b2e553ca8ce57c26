// SPDX-License-Identifier: MIT
// Steps of backward Euler that single bodies take in scenes of other schemes (input: backends/euler_form.py): where they touch something,
// and where the stages of ros2 come to too large an estimate. In a scene with contact a step is
//   - detection. A body with a contact that carried force in the last step takes backward Euler, and so does one that has rows with it;
//   - the step of the scheme itself, of the other bodies;
//   - a look at the paths of these: one that enters an obstacle or another body, or comes so near that the law acts, goes back to the
//     start of the step and takes backward Euler;
//   - backward Euler with the passes of contact.
// So the first step in which a contact carries no force any more is the last one of backward Euler, and what the scheme remembers of it
// holds no impulse of contact.
#pragma once
#include <cstring>

#include "contact.h"
#include "newton.h"
#include "rosenbrock.h"

static void search_all(Loop& loop);
static void take_mail(Launch& l, int64_t step);

static bool detects(const Loop& loop, int launch) {
    return loop.euler && launch >= loop.euler->detect && launch < loop.euler->detect + loop.euler->detects;
}

// Result of the solves of a body's step so far.
static SolveResult& step_result(Loop& loop, int i) { return loop.stages ? loop.stages->state[i].result : loop.euler->result[i]; }

// --- which bodies touch something ---------------------------------------------------------------------------------------------------

// A body that has rows with one that takes backward Euler takes it, too.
static void join_touching(Loop& loop) {
    const Contact& c = *loop.contact;
    int32_t* takes = loop.euler->takes;
    for (bool more = c.pair_first >= 0; more;) {
        more = false;
        for (int i = 0; i < loop.bodies; ++i)
            each_pair_range_of(c, i, [&](int first, int last) {
                for (int k = first; c.near[i] && k < last; ++k) {
                    const int other = c.obstacle[k];
                    if (other < 0 || takes[i] == takes[other]) continue;
                    takes[i] = takes[other] = 1;
                    more = true;
                }
            });
    }
}

// Detects contacts, and finds the bodies that touch something as the step begins.
static void detect_contacts(Loop& loop) {
    EulerForm& e = *loop.euler;
    const Contact& c = *loop.contact;
    const int64_t bytes = sizeof(double) * 3 * (int64_t)loop.nodes;
    std::memcpy(e.start_x, loop.x, bytes);
    std::memcpy(e.start_v, loop.v, bytes);
    std::memcpy(e.earlier, e.before, bytes);
    for (int k = e.detect; k < e.detect + e.detects; ++k) {
        take_mail(loop.launch[k], loop.rings.step);
        run(loop.launch[k], loop.threads);
    }
    detect_other_rows(loop);
    for (int i = 0; i < loop.bodies; ++i) {
        each_range_of(c, i, [&](int first, int last) {
            for (int k = first; k < last; ++k)
                if (c.obstacle[k] >= 0 && c.force[k] > 0) e.takes[i] = 1;
        });
    }
    join_touching(loop);
    for (int i = 0; i < loop.bodies; ++i) {
        e.touching[i] = e.takes[i] ? e.touching[i] + 1 : 0;
        if (!loop.stages) continue;
        StageState& s = loop.stages->state[i];
        const bool copied = copied_as_of_euler(loop, i);
        s.euler_copies = s.euler_copies << 1 | copied;
        if (copied) s.euler_step = loop.rings.step;
    }
}

// Makes the matrix of backward Euler of a copy of A of the scheme: K counts more, the diagonal (masses and springs) as it does.
static void as_of_euler(const Loop& loop, int index, double* copy) {
    const EulerForm& e = *loop.euler;
    const Body& body = loop.body[index];
    const double scale = e.block_scale[index];
    for (int i = body.first; i < body.last; ++i)
        for (int64_t k = loop.row_start[i]; loop.contact->free[i] != 0 && k < loop.row_start[i + 1]; ++k) {
            double* block = copy + 9 * (k - loop.row_start[body.first]);
            const double d = loop.columns[k] == i ? e.diagonal[i] : 0;
            for (int m = 0; m < 9; ++m) block[m] = scale * block[m] + (m % 4 == 0 ? (1 - scale) * d : 0);
        }
}

// Puts bodies whose step is made back to its start, and has `y` say where they ended, as solutions of backward Euler do.
static void hide_ends(Loop& loop) {
    EulerForm& e = *loop.euler;
    const Contact& c = *loop.contact;
    for (int i = 0; i < loop.bodies; ++i)
        for (int node = loop.body[i].first; !e.takes[i] && node < loop.body[i].last; ++node) {
            const int64_t at = 3 * (int64_t)node;
            double dv[3];
            for (int k = 0; k < 3; ++k) {
                e.end_x[at + k] = loop.x[at + k];
                dv[k] = (loop.x[at + k] - e.start_x[at + k]) / c.dx_dv - e.start_v[at + k];
                loop.x[at + k] = e.start_x[at + k];
            }
            rotated_back(c.rotation + 3 * at, dv, loop.y + at);
        }
}

static void show_ends(Loop& loop) {
    const EulerForm& e = *loop.euler;
    for (int i = 0; i < loop.bodies; ++i) {
        if (e.takes[i]) continue;
        const int64_t at = 3 * (int64_t)loop.body[i].first, end = 3 * (int64_t)loop.body[i].last;
        std::memcpy(loop.x + at, e.end_x + at, sizeof(double) * (end - at));
    }
}

// Finds the bodies that the step of the scheme brings to what they have rows with, or into an obstacle.
static void look_for_touch(Loop& loop) {
    EulerForm& e = *loop.euler;
    Contact& c = *loop.contact;
    single_islands(loop);
    Team::each(loop.threads, loop.bodies, [&](int i) {
        c.report[i] = {0, 0, 0, NAN, 0};
        std::fill_n(c.reaction + 6 * (int64_t)c.obstacle_count * i, 6 * c.obstacle_count, 0.0);
        if (e.takes[i]) return;
        Passes p(loop, i);
        p.choose_set();
        p.move_points();
        const bool acts = p.apply_law(false);
        e.takes[i] = sweep_obstacles(p) || acts;
    });
}

// --- the step -----------------------------------------------------------------------------------------------------------------------

static void set_coefficients(const EulerForm& e, const double (&to)[2]) {
    e.coefficients[0] = to[0];
    e.coefficients[1] = to[1];
}

// Takes bodies back to the start of the step, assembles backward Euler, and solves.
template <class F> static void assemble_euler(Loop& loop, F take_part) {
    const EulerForm& e = *loop.euler;
    run_for(loop, loop.launch[e.restore], take_part);
    set_coefficients(e, e.euler_coefficients);
    for (int k = 0; k < e.launches; ++k) run_for(loop, loop.launch[e.launch[k]], take_part);
    set_coefficients(e, e.own_coefficients);
}

// Begins the solves of bodies that have touched something for longer from the solutions of the step before.
static void start_from_last(Loop& loop) {
    const EulerForm& e = *loop.euler;
    for (int i = 0; i < loop.bodies; ++i)
        for (int node = loop.body[i].first; e.touching[i] > 1 && loop.moving[i] && node < loop.body[i].last; ++node)
            rotated_back(loop.contact->rotation + 9 * (int64_t)node, e.solution + 3 * (int64_t)node, loop.y + 3 * (int64_t)node);
}

static void keep_solutions(Loop& loop) {
    const EulerForm& e = *loop.euler;
    for (int i = 0; i < loop.bodies; ++i)
        for (int node = loop.body[i].first; e.takes[i] && node < loop.body[i].last; ++node)
            rotated(loop.contact->rotation + 9 * (int64_t)node, loop.y + 3 * (int64_t)node, e.solution + 3 * (int64_t)node);
}

// The step of the scheme itself, of bodies that touch nothing yet, with one solve or by Newton-Raphson.
static void make_own_step(Loop& loop) {
    if (loop.stages) { make_stages(loop); return; }
    EulerForm& e = *loop.euler;
    auto own = [&](int i) { return !e.takes[i]; };
    if (loop.newton) search_all(loop);
    each_body(loop, [&](int i) {
        Body& body = loop.body[i];
        const int64_t at = 3 * (int64_t)body.first;
        e.result[i] = SolveResult{0, 0, 0, CONVERGED, body.now.kind, 0};
        if (!own(i)) return;
        if (loop.newton) e.result[i] = as_solve_result(loop.newton->search[i]);
        else
            e.result[i] = pcg(matrix_of(loop, body), loop.b + at, body.factor, body.now, loop.y + at, loop.work + WORK * (int64_t)body.first,
                              !loop.moving[i], &body.correction);
    });
    for (int k = loop.before; k < loop.launches; ++k) run_for(loop, loop.launch[k], own);
}

// Makes the step of all bodies, each in its own form, and integrates.
static void make_step(Loop& loop) {
    const EulerForm& e = *loop.euler;
    auto takes = [&](int i) { return e.takes[i] != 0; };
    make_own_step(loop);
    if (loop.contact) {
        hide_ends(loop);
        look_for_touch(loop);
        do {
            join_touching(loop);
            assemble_euler(loop, takes);
            start_from_last(loop);
        } while (solve_in_contact(loop));
        keep_solutions(loop);
        show_ends(loop);
    } else {
        assemble_euler(loop, takes);
        for (int i = 0; i < loop.bodies; ++i)
            if (takes(i)) forget(step_result(loop, i));
        solve_stage(loop, true, takes);
    }
    for (int i = 0; i < loop.bodies; ++i) {
        if (!takes(i)) continue;
        if (loop.stages) loop.stages->state[i].form = EULER;
        if (!loop.contact) continue;
        forget(step_result(loop, i));
        note(step_result(loop, i), loop.contact->result[i]);
    }
    for (int k = 0; k < e.settles; ++k) run_for(loop, loop.launch[e.settle[k]], takes);
    run_for(loop, loop.launch[e.advance], takes);
}
