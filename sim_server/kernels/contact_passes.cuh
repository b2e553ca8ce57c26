// SPDX-License-Identifier: MIT
// What the solves of contact share on both devices (method: backends/cpu/native/contact.h): numbers, the exact line search, and paths of
// points past obstacles.
#pragma once
#include "contact_law.cuh"
#include "kinds.h"

// Rows that are hit within FIRST of the step after the first one count as closed in the first pass; a pass is solved to a part between
// EARLIEST and EARLY of its residual; a point that is held back stops at SHORT_OF of its way; a row that does not hold becomes HARDER times as stiff.
constexpr double FIRST = 0.02, EARLY = 0.03, EARLIEST = 0.1, SHORT_OF = 0.9, HARDER = 10;
constexpr double SAME_PLANE = 0.995;  // cosine of the angle between normals
constexpr int ROUNDS = 3;             // of passes after a sweep of the paths
constexpr double HARDEST = 1000;      // times as stiff, at most
constexpr double RESTING = 1e-5;      // contact residual of a step that began at rest
constexpr int AT_REST = 4;            // passes of such a step, at most

// The contact residual with which a step may end. rested: the law held where it began. What is left of the residual then moves the body
// in the next step: within `tolerance` alone one near the limit of friction would go to and fro for ever.
// passes: made; most: of any step.
HOST_DEVICE double tolerance_of(double tolerance, bool rested, int passes, int most) {
    return rested && passes < AT_REST && passes < most && RESTING < tolerance ? RESTING : tolerance;
}

// True if a sweep of the paths after a solve is to give rows to what enters something, for another solve; else that is held back. Where
// there are no passes left, nothing would balance the forces of such rows. rounds: of passes after a sweep; passes: made; most: of any step.
HOST_DEVICE bool gives_rows(int rounds, int passes, int most) {
    return rounds < ROUNDS && passes < most;
}

// Status of a step in contact whose solves came to `status`: it does not end where they did if the law does not hold there, or if nodes
// were set back or held apart after them (`clipped`).
HOST_DEVICE int status_in_contact(int status, bool holds, int clipped) {
    return status == CONVERGED && (!holds || clipped > 0) ? CONTACT : status;
}

// Part of its residual to which a pass is solved that need not be the last one: the nearer to the solution the more exactly, since the next
// one then profits; but no more exactly than the law asks for (forcing terms: Eisenstat and Walker, Choosing the forcing terms in an
// inexact Newton method, 1996). residual: contact residual before the pass. passes: made; most: of any step.
HOST_DEVICE double early_tolerance(double residual, double tolerance, int passes, int most) {
    const double wanted = fmax(3 * residual, 0.5 * tolerance / residual);
    return passes + 1 >= most || wanted < EARLY ? EARLY : wanted < EARLIEST ? wanted : EARLIEST;
}

// Hardening that a row takes into the next step: one that carried force before and whose force without it would press it through half of
// its thickness keeps HARDER. before, force: normal forces at the start and the end of the step.
HOST_DEVICE double lasting_hardening(double hardening, double before, double force, double stiffness, double thickness) {
    return hardening > 1 && before > 0 && 2 * force > stiffness * thickness ? HARDER : 1;
}

// Zero of a slope that ascends: 1 where it is zero there but for rounding. slope(alpha) is the derivative along a solution.
template <class Slope> HOST_DEVICE double minimum_along(Slope slope) {
    const double start = slope(0.0);
    double low = 0, high = 1, at_low = start, at_high = slope(1.0);
    if (!(start < 0)) return 1;  // rounding
    if (fabs(at_high) <= 1e-9 * -start) return 1;
    while (at_high < 0 && high < 8) {
        low = high;
        at_low = at_high;
        high *= 2;
        at_high = slope(high);
    }
    if (at_high < 0) return high;
    for (int k = 0; k < 60 && high - low > 1e-10 * high; ++k) {
        double mid = k % 3 == 2 ? 0.5 * (low + high) : low + (high - low) * at_low / (at_low - at_high);
        if (!(mid > low && mid < high)) mid = 0.5 * (low + high);
        const double here = slope(mid);
        if (here == 0) return mid;
        if (here < 0) {
            low = mid;
            at_low = here;
        } else {
            high = mid;
            at_high = here;
        }
    }
    return 0.5 * (low + high);
}

// The part of the way from -> to (world frame, at the start and the end of the step) at which a point comes as near as `inflate` to an
// obstacle; NEVER: it does not, or it was inside. begin, end: out, the way in the frame of the obstacle.
HOST_DEVICE double entry_of_way(const ObstacleTable& t, int obstacle, double inflate, const double* from, const double* to, double* begin,
                                double* end) {
    local_point(t.begin + 7 * obstacle, from, begin);
    local_point(t.end + 7 * obstacle, to, end);
    double n[3];
    const double way[3] = {end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]}, distance = distance_to(t, obstacle, begin, n);
    if (!(distance > 0) || distance - inflate > sqrt(dot3(way, way))) return NEVER;
    return entry_time(t, obstacle, begin, end, inflate);
}

// Plane that stands for an obstacle where a point is at part `time` of its way: its normal and its drift, world frame; returns the
// gap of the point at the start of the step. begin, end: as of entry_of_way.
HOST_DEVICE double plane_on_way(const ObstacleTable& t, int obstacle, const double* from, const double* begin, const double* end, double time,
                                double* normal, double* drift) {
    double p[3], n[3], q[3], at_begin[3], at_end[3], gap = 0;
    for (int m = 0; m < 3; ++m) p[m] = begin[m] + time * (end[m] - begin[m]);
    const double distance = distance_to(t, obstacle, p, n);
    for (int m = 0; m < 3; ++m) q[m] = p[m] - distance * n[m];
    world_point(t.begin + 7 * obstacle, q, at_begin);
    world_point(t.end + 7 * obstacle, q, at_end);
    world_vector(t.end + 7 * obstacle, n, normal);
    for (int m = 0; m < 3; ++m) {
        drift[m] = at_end[m] - at_begin[m];
        gap += normal[m] * (from[m] - at_end[m]);
    }
    return gap;
}

// The obstacle, of all but `but`, that the way of a point enters first; -1: it enters none. entry(obstacle, from, to, begin, end): as
// entry_of_way. back: out, the place in front of it, world frame
template <class Entry>
HOST_DEVICE int first_entered(const ObstacleTable& t, int count, int but, const double* from, const double* to, double* back, Entry entry) {
    int first = -1;
    double begin[3], end[3], earliest = NEVER;
    for (int o = 0; o < count; ++o) {
        if (o == but) continue;
        const double time = entry(o, from, to, begin, end);
        if (time > 1 || time >= earliest) continue;
        first = o;
        earliest = time;
        for (int m = 0; m < 3; ++m) back[m] = begin[m] + SHORT_OF * time * (end[m] - begin[m]);
        world_point(t.end + 7 * o, back, back);
    }
    return first;
}

// A point that is set back in front of an obstacle that moves may enter another one by that: the two close over it, and there is no place
// for it. Of those in front of either it takes the one nearer to where it began: the other one would throw it, and whichever is looked
// at last would win. back: in, out
template <class Entry>
HOST_DEVICE void place_between(const ObstacleTable& t, int count, int obstacle, const double* from, double* back, Entry entry) {
    double other[3], way = 0, other_way = 0;
    if (first_entered(t, count, obstacle, from, back, other, entry) < 0) return;
    for (int m = 0; m < 3; ++m) {
        way += (back[m] - from[m]) * (back[m] - from[m]);
        other_way += (other[m] - from[m]) * (other[m] - from[m]);
    }
    for (int m = 0; m < 3 && other_way < way; ++m) back[m] = other[m];
}

// Where a point whose way enters obstacles is set back to. False if it enters none.
template <class Entry>
HOST_DEVICE bool place_in_front(const ObstacleTable& t, int count, const double* from, const double* to, double* back, Entry entry) {
    const int first = first_entered(t, count, -1, from, to, back, entry);
    if (first >= 0) place_between(t, count, first, from, back, entry);
    return first >= 0;
}

// Stiffness of a row as a factor is to know it: one that slid counts with its normal stiffness alone. force, traction: of the row.
HOST_DEVICE ContactForce lasting_contact(double friction, double force, const double* traction) {
    ContactForce f = {force, {0, 0, 0}, 0, true};
    if (dot3(traction, traction) < 0.98 * (friction * force) * (friction * force)) f.slip = 1;
    return f;
}
