// SPDX-License-Identifier: MIT
// A step of a body that touches obstacles, on a CPU (law: kernels/contact_law.cuh; numbers, line search and planes:
// kernels/contact_passes.cuh; what it is for: docs/contact.md).
//
// Elasticity is linearized once, as without contact (several times: newton_contact.h); the law of contact is solved with it, by a
// semi-smooth Newton method. A pass is
//   - the rows in the state reached: force f, stiffness S. In the first pass the rows that carried force in the last step and those
//     that are hit first (FIRST) count as closed, with the force of a spring that may pull, unless the law holds already; afterwards
//     the law decides;
//   - (A + H^T S H) dy = r, r = b - A y + i H^T f, solved to a part of |r| (early_tolerance);
//   - y += alpha dy, alpha the exact minimum along dy of the convex function of which -r is the gradient;
//   - the normal force found is what limits friction in the next pass; 0 in a row that the solve did not take as closed: a force
//     that no solve has balanced would glue.
// It ends when |r| <= Contact::tolerance max(|b|, |b + i H^T f|) with the law as it is then; a last solve to the tolerance of the step follows.
//
// The path of each point of the surface is then swept against all obstacles. Those that pass into one get a row where they enter, or a
// stiffer one where they have it, and the passes go on, at most ROUNDS times, while there are any. What is still left at the end, after
// bodies have been held apart, since obstacles do not give way, is set to SHORT_OF of the way and counted as clipped. A row stays stiffer as long as its force would press it through half of its thickness without that, so that a lasting load
// that the given stiffness does not bear comes to rest.
#pragma once
#include "contact_copies.h"
#include "contact_report.h"
#include "faces.h"
#include "island_groups.h"
#include "obstacle_sweep.h"
#include "pairs.h"
#include "passes.h"
#include "ties.h"

// Sets the rows of a step but for those of nodes against obstacles, which are set.
static void detect_other_rows(Loop& loop) {
    if (loop.contact->face_start) FaceDetection{loop, *loop.contact}.run();
    if (loop.contact->pair_first >= 0) PairDetection(loop, *loop.contact).run();
}

// Gives points and triangles that y takes into an obstacle rows there. Returns whether there are such.
static bool sweep_obstacles(Passes& p) {
    const bool points = ObstacleSweep(p).sweep(), faces = FaceSweep(p).sweep();
    if (!points && !faces) return false;
    p.list_rows();
    p.move_points();
    return true;
}

// Sets those that y still takes into one back, at the end of a step; counts the nodes that are moved in the reports of their bodies.
static void hold_back(const Passes& p) {
    p.each_entry([&](int64_t k) { p.before[k] = p.y[k]; });
    ObstacleSweep(p).clip();
    for (int k = 0; k < HOLDS && FaceSweep(p).clip(); ++k) ObstacleSweep(p).clip();
    for (int m = 0; m < p.count; ++m) {
        const Body& body = p.loop.body[p.bodies[m]];
        for (int64_t k = 3 * (int64_t)body.first; k < 3 * (int64_t)body.last; k += 3)
            p.c.report[p.bodies[m]].clipped += !std::equal(p.y + k, p.y + k + 3, p.before + k);
    }
}

// The step of an island whose rows are detected; of a body alone as without contact where nothing is touched. enters: of each body,
// whether y may take it into an obstacle
static void solve_island(Loop& loop, int island, bool resumes, char* enters) {
    Passes p(loop, island);
    const int first = p.bodies[0], set = resumes ? 0 : p.choose_set();
    bool outside = false;  // y was swept and enters nothing
    if (p.count > 1) IslandSolver::make_modes(loop, p.c, p.bodies, p.count);
    if (resumes) {
        p.take_up();
        p.leave();
        p.move_points();
        p.solve(false);
    } else if (set || p.count > 1) {
        p.start();
        const bool rested = p.rests();
        p.solve(!rested, rested);
    } else {
        Body& body = loop.body[first];
        const int64_t at = 3 * (int64_t)body.first;
        p.rows.actives = 0;
        tell_correction(p.rows, body);
        SolveSettings settings = body.now;
        settings.dx_dv = p.c.dx_dv;
        p.result = pcg(matrix_of(loop, body), loop.b + at, body.factor, settings, loop.y + at, loop.work + WORK * (int64_t)body.first,
                       !loop.moving[first], &body.correction);
        if (p.result.status != NOT_FINITE) {
            p.move_points();
            const bool acts = p.apply_law(false);
            outside = !sweep_obstacles(p) && !acts;
            if (!outside) {
                p.leave();
                p.solve(false);
            }
        }
    }
    for (int k = 0; !outside && gives_rows(k, p.report.passes, p.c.passes) && p.result.status != NOT_FINITE; ++k) {
        outside = !sweep_obstacles(p);
        if (!outside) p.solve(false);
    }
    if (p.result.status == NOT_FINITE) p.each_entry([&](int64_t k) { p.y[k] = NAN; });  // the kernel `advance` takes the bodies back
    for (int m = 0; m < p.count; ++m) {
        p.c.result[p.bodies[m]] = p.result;
        p.c.report[p.bodies[m]] = p.report;
        enters[p.bodies[m]] = p.result.status != NOT_FINITE && !outside;
    }
}

// f(island), those of several bodies first.
template <class F> static void each_island(Loop& loop, F f) {
    const Contact& c = *loop.contact;
    auto size = [&](int i) { return c.island_start[i + 1] - c.island_start[i]; };
    for (int i = 0; i < c.islands; ++i)
        if (size(i) > 1) f(i);
    each_about_a_body(loop, c.islands, [&](int i) { return c.island[c.island_start[i]]; }, [&](int i) { if (size(i) == 1) f(i); });
}

// Solves islands. resumes: only those that a sweep has given rows.
static void solve_islands(Loop& loop, bool resumes, char* enters) {
    const Contact& c = *loop.contact;
    each_island(loop, [&](int i) {
        bool wanted = !resumes;
        for (int k = c.island_start[i]; k < c.island_start[i + 1] && !wanted; ++k) wanted = c.touched[c.island[k]];
        if (wanted) solve_island(loop, i, resumes, enters);
    });
}

// Sets back what the step takes into obstacles, where a body may come to one or was held apart from others.
static void hold_islands_back(Loop& loop, const char* enters) {
    const Contact& c = *loop.contact;
    each_island(loop, [&](int i) {
        const int first = c.island[c.island_start[i]];
        const bool apart = c.report[first].clipped > 0 && c.result[first].status != NOT_FINITE;  // told of all of its bodies
        if (enters[first] || apart) hold_back(Passes(loop, i));
    });
}

// Solves all bodies whose step is not made. Those that pass through each other then get rows where they do, and are solved again. True
// if one whose step is made is among them: then nothing is done yet.
static bool solve_in_contact(Loop& loop) {
    static thread_local std::vector<char> enters;
    Contact& c = *loop.contact;
    enters.assign(loop.bodies, 0);
    find_islands(loop);
    solve_islands(loop, false, enters.data());
    for (int k = 0; k < ROUNDS && c.pair_first >= 0; ++k) {
        if (!PairDetection(loop, c, loop.y).sweep(c.room, k == 0)) break;
        if (unmake_touched(loop)) return true;
        find_islands(loop);
        solve_islands(loop, true, enters.data());
        if (k == ROUNDS - 1) PairDetection(loop, c, loop.y).hold_back(c.room, loop.y);
    }
    hold_islands_back(loop, enters.data());
    for (int i = 0; i < c.islands; ++i) {
        Passes p(loop, i);
        p.conclude(!(c.report[p.bodies[0]].residual > c.tolerance));
        ContactEnd(p, p.result, p.report).finish();
    }
    if (c.ties.count) TieRows(loop).finish(loop.rings.step + 1);
    return false;
}
