// SPDX-License-Identifier: MIT
// The passes of contact over an island (method: contact.h); allocates nothing.
#pragma once
#include <algorithm>
#include <cmath>

#include "contact_copies.h"
#include "island.h"
#include "island_rows.h"
#include "pass_choice.h"

struct Passes : IslandRows {
    double *left, *r, *dy, *before, *rest;  // b - A y; with contact; solution of a pass; r before its solve; residual of its solve
    const double scale2;                 // i c, of S
    ContactReport report = {0, 0, 0, NAN, 0};
    SolveResult result;
    double given;                        // what |r| is relative to
    const double contact_tolerance;      // of the residual with the law

    Passes(Loop& loop, int island)
        : IslandRows(loop, island), scale2(c.dx_dv * c.force_coefficient), result{0, 0, 0, CONVERGED, loop.body[bodies[0]].now.kind, 0},
          contact_tolerance(loop.newton && !loop.euler ? std::min(c.tolerance, loop.newton->most.tolerance) : c.tolerance) {
        const int64_t n = 3 * (int64_t)loop.nodes;
        left = c.room;
        r = left + n; dy = r + n; before = dy + n; rest = before + n;
    }

    // Rows that count as closed in the first pass: returns how many, and marks them.
    int choose_set() const {
        double earliest = 2;
        int closed = 0;
        each_row([&](int k, RowState&) { earliest = std::min(earliest, c.entry[k]); });
        each_row([&](int k, RowState& s) {
            s.limit = c.force[k];
            std::copy(c.traction + 3 * k, c.traction + 3 * k + 3, s.dual);
            bound_dual(rows.row(k), s.limit, s.dual);
            s.in_set = is_tie(c, k) || c.force[k] > 0 || (c.entry[k] <= 1 && c.entry[k] <= earliest + FIRST);
            closed += s.in_set;
        });
        return closed;
    }

    // Forces and stiffness of the rows as they are. set: those marked count as closed. exactly: friction is linearized by its derivative.
    // Returns whether a row has either.
    bool apply_law(bool set, bool exactly = false) {
        rows.actives = 0;
        each_row([&](int k, RowState& s) {
            s.force = rows.force(k, s.s, s.limit, set && s.in_set);
            if (exactly) std::copy(s.force.traction, s.force.traction + 3, s.dual);
            rows.stiffness(k, s.force, s.dual, scale2, s.stiffness);
            if (rows.acts(k)) active[rows.actives++] = k;
        });
        return rows.actives > 0;
    }

    // r = left + i H^T f, given = the larger one of |b| and |b + i H^T f|, which is 0 at rest; returns |r|.
    double balance() {
        each_entry([&](int64_t k) { r[k] = 0; });
        each_row([&](int k, RowState& s) {
            double f[3];
            for (int m = 0; m < 3; ++m) f[m] = c.force_coefficient * (s.force.normal * c.normal[3 * k + m] + s.force.traction[m]);
            rows.scatter(k, f, r);
        });
        double all = 0, own = 0, sum = 0;
        each_entry([&](int64_t k) {
            const double f = r[k];
            all += (b[k] + f) * (b[k] + f);
            own += b[k] * b[k];
            r[k] = left[k] + f;
            sum += r[k] * r[k];
        });
        given = std::sqrt(std::max(all, own));
        return std::sqrt(sum);
    }

    // Slope along dy at y + alpha dy of the function that a pass minimizes. dot_left: dy . (b - A y); curvature: dy . A dy.
    double slope(double alpha, double dot_left, double curvature) const {
        double sum = alpha * curvature - dot_left;
        const double factor = c.force_coefficient / c.dx_dv;
        each_row([&](int k, RowState& s) {
            double at[3];
            for (int m = 0; m < 3; ++m) at[m] = s.s[m] + alpha * s.step[m];
            const ContactForce f = rows.force(k, at, s.limit, false);
            sum -= factor * (f.normal * dot3(c.normal + 3 * k, s.step) + dot3(f.traction, s.step));
        });
        return sum;
    }

    // True if the budget has ended a solve. Those that follow in the step have one iteration each, which are not counted, so that a
    // replay knows from the count where the budget ended.
    bool cut() const { return result.status == BUDGET; }

    // last: the solve may end by the error of the positions, within the law's tolerance of the residual.
    SolveSettings settings_for(double tolerance, bool last, double most) const {
        SolveSettings s = loop.body[bodies[0]].now;
        s.tolerance = tolerance;
        s.warm_start = 0;
        s.probe = 0;
        s.dx_dv = c.dx_dv;
        if (!last) s.position = 0;
        s.residual_limit = most;
        if (s.budget > 0) s.budget = std::max(s.budget - result.seconds, 1e-9);
        if (s.budget < 0) s.budget = cut() ? -2 : std::min(-1.0, s.budget + result.iterations);
        return s;
    }

    // Relative residual at which a pass ends, as far as that is known beforehand.
    static double expected_end(const SolveSettings& s) { return s.position > 0 ? std::max(s.tolerance, s.residual_limit) : s.tolerance; }

    // dy of (A + H^T S H) dy = r, and its residual.
    SolveResult solve_linear(double tolerance, bool last, double most) {
        SolveSettings settings = settings_for(tolerance, last, most);
        if (count > 1) return solve_together(settings);
        Body& body = loop.body[bodies[0]];
        const int64_t at = 3 * (int64_t)body.first;
        Rows own = rows;
        own.node_first = body.first;
        BlockCsr A = matrix_of(loop, body);
        A.rows = &own;
        double* work = loop.work + WORK * (int64_t)body.first;
        tell_correction(rows, body);
        auto solve_by = [&] { return pcg(A, r + at, body.factor, settings, dy + at, work, false, &body.correction); };
        SolveResult solved;
        if (settings.kind == CHOLESKY && body.factor) {
            ChoiceOfPass choice(c.choice[bodies[0]]);
            choice.add(A, body.factor);
            choice.begin(settings, expected_end(settings));
            solved = solve_by();
            choice.end(solved, body.correction.spent);
        } else {
            solved = solve_by();
        }
        std::copy(work, work + A.size(), rest + at);  // where pcg leaves its residual
        return solved;
    }

    // The same of an island of several bodies. What is known of its choice is kept with its first body.
    SolveResult solve_together(SolveSettings& settings) {
        IslandSolver solver{loop, c, bodies, count, rows};
        ChoiceOfPass choice(c.choice[bodies[0]]);
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            choice.add(matrix_of(loop, body), IslandSolver::factor_of(body));
        }
        settings.kind = BLOCK_JACOBI;
        const bool chooses = choice.pass.factor_step >= 0;
        if (chooses) choice.begin(settings, expected_end(settings));
        const SolveResult solved = solver.solve(r, settings, dy, rest);
        double spent = 0;
        if (chooses) choice.end(solved, spent);
        return solved;
    }

    // Solves (A + H^T S H) dy = r and moves y by alpha dy, left accordingly. tolerance: of |r|. exactly: alpha is 1. most: of |r|, in a solve
    // that ends by the error of positions.
    void pass(double tolerance, bool exactly, double most) {
        each_entry([&](int64_t k) { before[k] = r[k]; });
        const SolveResult solved = solve_linear(tolerance, exactly, most);
        ++report.passes;
        result.seconds += solved.seconds;
        if (!cut()) result.iterations += solved.iterations;
        result.fallbacks += solved.fallbacks;
        result.kind = solved.kind;
        if (!cut() || solved.status == NOT_FINITE) result.status = solved.status;
        result.solve_error = solved.solve_error;
        result.residual = solved.residual;  // of |r|; of what is given at the end of the step
        if (solved.status == NOT_FINITE) return;
        // A dy = r - (residual of the solve) - H^T S H dy: no more product with A.
        each_entry([&](int64_t k) { r[k] = 0; });
        rows.add_product(dy, r);
        double dot_left = 0, curvature = 0;
        each_entry([&](int64_t k) {
            r[k] = before[k] - rest[k] - r[k];  // A dy
            dot_left += dy[k] * left[k];
            curvature += dy[k] * r[k];
        });
        each_row([&](int k, RowState& s) {
            double u[3] = {0, 0, 0};
            rows.gather(k, dy, u);
            for (int m = 0; m < 3; ++m) s.step[m] = c.dx_dv * u[m];
        });
        const double alpha = exactly ? 1 : minimum_along([&](double at) { return slope(at, dot_left, curvature); });
        each_entry([&](int64_t k) {
            y[k] += alpha * dy[k];
            left[k] -= alpha * r[k];
        });
        each_row([&](int k, RowState& s) {
            for (int m = 0; m < 3; ++m) {
                s.step[m] *= alpha;
                s.s[m] += s.step[m];
            }
            move_dual(rows.row(k), s.force, s.step, s.dual);
        });
    }

    // Normal forces at the state reached limit friction from now on, where the solve took the row as closed.
    void hold_limits() const {
        each_row([&](int k, RowState& s) {
            const bool was = s.force.closed;
            s.limit = was ? rows.force(k, s.s, 0, false).normal : 0;
            bound_dual(rows.row(k), s.limit, s.dual);
        });
    }

    // True if the rows that count as closed are those that the law closes.
    bool set_is_law() const {
        bool same = true;
        each_row([&](int k, RowState& s) { same = same && s.in_set == rows.force(k, s.s, 0, false).closed; });
        return same;
    }

    // set: begin with the rows marked by choose_set. rested: the law held where it began.
    void solve(bool set, bool rested = false) {
        bool last = false, spent = false, linear = true;
        each_row([&](int k, RowState&) { linear = linear && is_tie(c, k); });
        for (int k = 0;; ++k) {
            apply_law(set && k == 0, rested && k == 0);
            const double size = balance();
            if (!std::isfinite(size)) { result.status = NOT_FINITE; return; }
            report.residual = given > 0 ? size / given : 0;
            const bool holds = report.residual <= tolerance_of(contact_tolerance, rested, report.passes, c.passes);
            if (spent || (last && holds)) break;  // the last solve may have changed the law again
            const double goal = loop.body[bodies[0]].now.tolerance * given;
            const bool by_law = k > 0 || !set || set_is_law();
            last = by_law && (linear || size <= contact_tolerance * given);
            if (last && size <= goal) {  // there is nothing left to solve
                result.residual = report.residual;
                if (!cut()) result.status = CONVERGED;  // whatever an earlier solve of the step came to
                return;
            }
            if (!last && report.passes >= c.passes) break;
            const double early = early_tolerance(report.residual, contact_tolerance, report.passes, c.passes);
            pass(last ? goal / size : std::max(goal / size, early), last, WITHIN * contact_tolerance * given / size);
            result.residual *= given > 0 ? size / given : 0;
            if (result.status == NOT_FINITE) return;
            spent = cut();
            hold_limits();
        }
    }

    // |r| at the state y with the set closed.
    double size_at() {
        move_points();
        apply_law(true);
        return balance();
    }

    // left = b - A y
    void leave() const {
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            const int64_t at = 3 * (int64_t)body.first;
            residual(matrix_of(loop, body), b + at, y + at, left + at);
        }
    }

    // Begins with the better one of the last solution and zero; left = b - A y.
    void start() {
        auto zero = [&] {
            each_entry([&](int64_t k) {
                y[k] = 0;
                left[k] = b[k];
            });
        };
        if (!loop.body[bodies[0]].now.warm_start) { zero(); move_points(); return; }
        leave();
        const double warm = size_at();
        each_entry([&](int64_t k) {
            dy[k] = y[k];
            before[k] = left[k];
        });
        zero();
        if (size_at() <= warm || !(warm < INFINITY)) return;
        each_entry([&](int64_t k) {
            y[k] = dy[k];
            left[k] = before[k];
        });
        move_points();
    }

    // True if the law holds where it begins, so that rows that would be hit without it need not count as closed.
    bool rests() {
        apply_law(false);
        const double size = balance();
        return size <= contact_tolerance * given;
    }

    // Goes on with what an earlier solve of the step has come to. An island that grew counts what its first body has.
    void take_up() {
        result = c.result[bodies[0]];
        report = c.report[bodies[0]];
    }

    // At the end of the step. holds: the law does. What was set back is each body's own.
    void conclude(bool holds) {
        take_up();
        for (int m = 0; m < count; ++m) c.result[bodies[m]].status = status_in_contact(result.status, holds, c.report[bodies[m]].clipped);
    }
};
