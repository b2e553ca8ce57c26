// SPDX-License-Identifier: MIT
// A step of a body that touches obstacles, on a CPU (law: kernels/contact_law.cuh; numbers, line search and planes:
// kernels/contact_passes.cuh; what it is for: docs/contact.md).
//
// A pass that its factor has not solved after PATIENT iterations goes on with block Jacobi, and so do the passes after it: contacts that
// the factor does not know, or knows although they are gone, may cost it many iterations, each of which costs several of block Jacobi.
//
// Elasticity is linearized once, as without contact; the law of contact is solved with it, by a semi-smooth Newton method. A pass is
//   - the rows in the state reached: force f, stiffness S. In the first pass the rows that carried force in the last step and those
//     that are hit first (FIRST) count as closed, with the force of a spring that may pull, unless the law holds already; afterwards
//     the law decides;
//   - (A + H^T S H) dy = r, r = b - A y + i H^T f, solved to EARLY of |r|;
//   - y += alpha dy, alpha the exact minimum along dy of the convex function of which -r is the gradient;
//   - the normal force found is what limits friction in the next pass; 0 in a row that the solve did not take as closed: a force
//     that no solve has balanced would glue.
// It ends when |r| <= Contact::tolerance max(|b|, |b + i H^T f|) with the law as it is then; a last solve to the tolerance of the step follows.
//
// The path of each point of the surface is then swept against all obstacles. Those that pass into one get a row where they enter, or a
// stiffer one where they have it, for this step only, and the passes go on, at most ROUNDS times; what is still left is set to
// SHORT_OF of the way and counted as clipped.
#pragma once
#include <algorithm>
#include <cmath>

#include "island.h"
#include "loop.h"
#include "pairs.h"

constexpr int PATIENT = 40;  // iterations of a pass with a factor

// The passes of an island, bodies that touch each other and are solved as one system, or of one body; allocates nothing. Vectors are of
// the whole scene's nodes, of which it uses those of its bodies.
struct Passes {
    Loop& loop;
    Contact& c;
    const int32_t* bodies;
    const int32_t count;
    const bool pairs;                    // rows between bodies count
    Rows rows;
    int32_t* const active;               // its rows that act
    const double* b;
    double* y;
    double *left, *r, *dy, *before, *rest;  // b - A y; with contact; solution of a pass; r before its solve; residual of its solve
    const double scale2;                 // i c, of S
    ContactReport report = {0, 0, 0, NAN, 0};
    SolveResult result;
    double given;                        // what |r| is relative to

    Passes(Loop& loop, int island)
        : loop(loop), c(*loop.contact), bodies(c.island + c.island_start[island]),
          count(c.island_start[island + 1] - c.island_start[island]), pairs(c.pair_first >= 0),
          rows{c, 0, c.active + c.island_rows[island], 0}, active(c.active + c.island_rows[island]), b(loop.b), y(loop.y),
          scale2(c.dx_dv * c.force_coefficient), result{0, 0, 0, CONVERGED, loop.body[bodies[0]].now.kind, 0} {
        const int64_t n = 3 * (int64_t)loop.nodes;
        left = c.room;
        r = left + n; dy = r + n; before = dy + n; rest = before + n;
    }

    template <class F> void each_entry(F f) const {
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            for (int64_t k = 3 * (int64_t)body.first; k < 3 * (int64_t)body.last; ++k) f(k);
        }
    }
    // f(first, last) of the rows of each body, those with its own vertices
    template <class F> void each_range(F f) const {
        for (int m = 0; m < count; ++m) {
            const int first = c.body_start[bodies[m]], last = c.body_start[bodies[m] + 1];
            f(first, last);
            if (pairs) f(c.pair_first + first, c.pair_first + last);
        }
    }
    template <class F> void each_row(F f) const {
        each_range([&](int first, int last) {
            for (int k = first; k < last; ++k)
                if (!rows.empty(k)) f(k, c.state[k]);
        });
    }

    // Displacements of the points by velocities y.
    void move_points() const {
        each_row([&](int k, RowState& s) {
            double u[3] = {0, 0, 0}, p[3];
            rows.gather(k, y, u);
            rows.at_point(k, c.predictor, p);
            for (int m = 0; m < 3; ++m) s.s[m] = c.dx_dv * (p[m] + u[m]);
        });
    }

    // Rows that count as closed in the first pass: returns how many, and marks them.
    int choose_set() const {
        double earliest = 2;
        int closed = 0;
        each_row([&](int k, RowState&) { earliest = std::min(earliest, c.entry[k]); });
        each_row([&](int k, RowState& s) {
            s.limit = c.force[k];
            s.hardening = 1;
            s.in_set = c.force[k] > 0 || (c.entry[k] <= 1 && c.entry[k] <= earliest + FIRST);
            closed += s.in_set;
        });
        return closed;
    }

    // Forces and stiffness of the rows as they are. set: those marked count as closed. Returns whether a row has either.
    bool apply_law(bool set) {
        rows.actives = 0;
        each_row([&](int k, RowState& s) {
            const ContactRow row = rows.row(k);
            s.force = contact_force(row, s.s, s.limit, set && s.in_set);
            contact_stiffness(row, s.force, scale2, s.stiffness);
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
            const ContactForce f = contact_force(rows.row(k), at, s.limit, false);
            sum -= factor * (f.normal * dot3(c.normal + 3 * k, s.step) + dot3(f.traction, s.step));
        });
        return sum;
    }

    // True if the budget has ended a solve. Those that follow in the step have one iteration each, which are not counted, so that a
    // replay knows from the count where the budget ended.
    bool cut() const { return result.status == BUDGET; }

    SolveSettings settings_for(double tolerance) const {
        SolveSettings s = loop.body[bodies[0]].now;
        s.tolerance = tolerance;
        s.warm_start = 0;
        if (report.passes > 0 && result.kind == BLOCK_JACOBI) s.kind = BLOCK_JACOBI;
        s.probe = s.kind == CHOLESKY ? PATIENT : 0;
        if (s.budget > 0) s.budget = std::max(s.budget - result.seconds, 1e-9);
        if (s.budget < 0) s.budget = cut() ? -2 : std::min(-1.0, s.budget + result.iterations);
        return s;
    }

    // dy of (A + H^T S H) dy = r, and its residual.
    SolveResult solve_linear(double tolerance) {
        const SolveSettings settings = settings_for(tolerance);
        if (count > 1) return IslandSolver{loop, c, bodies, count, rows}.solve(r, settings, dy, rest);
        Body& body = loop.body[bodies[0]];
        const int64_t at = 3 * (int64_t)body.first;
        Rows own = rows;
        own.node_first = body.first;
        const BlockCsr A{body.first, body.last, loop.row_start, loop.columns, loop.values, &own};
        double* work = loop.work + 27 * (int64_t)body.first;
        const SolveResult solved = pcg(A, r + at, body.factor, settings, dy + at, work, false, &body.correction);
        std::copy(work, work + A.size(), rest + at);  // where pcg leaves its residual
        return solved;
    }

    // Solves (A + H^T S H) dy = r and moves y by alpha dy, left accordingly. tolerance: of |r|. exactly: alpha is 1.
    void pass(double tolerance, bool exactly) {
        each_entry([&](int64_t k) { before[k] = r[k]; });
        const SolveResult solved = solve_linear(tolerance);
        ++report.passes;
        result.seconds += solved.seconds;
        if (!cut()) result.iterations += solved.iterations;
        result.fallbacks += solved.fallbacks;
        result.kind = solved.kind;
        if (!cut() || solved.status == NOT_FINITE) result.status = solved.status;
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
        each_row([&](int, RowState& s) {
            for (int m = 0; m < 3; ++m) s.s[m] += alpha * s.step[m];
        });
    }

    // Normal forces at the state reached limit friction from now on, where the solve took the row as closed.
    void hold_limits() const {
        each_row([&](int k, RowState& s) {
            const bool was = s.force.closed;
            s.limit = was ? contact_force(rows.row(k), s.s, 0, false).normal : 0;
        });
    }

    // True if the rows that count as closed are those that the law closes.
    bool set_is_law() const {
        bool same = true;
        each_row([&](int k, RowState& s) { same = same && s.in_set == contact_force(rows.row(k), s.s, 0, false).closed; });
        return same;
    }

    // set: begin with the rows marked by choose_set.
    void solve(bool set) {
        bool last = false, spent = false;
        for (int k = 0;; ++k) {
            apply_law(set && k == 0);
            const double size = balance();
            if (!std::isfinite(size)) { result.status = NOT_FINITE; return; }
            report.residual = given > 0 ? size / given : 0;
            if (spent || (last && report.residual <= c.tolerance)) break;  // the last solve may have changed the law again
            const double goal = loop.body[bodies[0]].now.tolerance * given;
            const bool by_law = k > 0 || !set || set_is_law();
            last = by_law && size <= c.tolerance * given;
            if (last && size <= goal) {  // there is nothing left to solve
                result.residual = report.residual;
                return;
            }
            if (!last && report.passes >= c.passes) break;
            pass(last ? goal / size : std::max(goal / size, EARLY), last);
            result.residual *= given > 0 ? size / given : 0;
            if (result.status == NOT_FINITE) return;
            spent = cut();
            hold_limits();
        }
        if (report.residual > c.tolerance && result.status == CONVERGED) result.status = CONTACT;
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
        return size <= c.tolerance * given;
    }

    // f(k) of the first row against obstacles of each point
    template <class F> void each_site(F f) const {
        for (int m = 0; m < count; ++m)
            for (int k = c.body_start[bodies[m]]; k < c.body_start[bodies[m] + 1]; k += 2) f(k);
    }

    // Point of a site, at the start of the step and moved by y. Both rows of a node have the same.
    void path(int k, double* from, double* to) const {
        double u[3] = {0, 0, 0}, p[3];
        rows.at_point(k, loop.x, from);
        rows.at_point(k, c.predictor, p);
        rows.gather(k, y, u);
        for (int m = 0; m < 3; ++m) to[m] = from[m] + c.dx_dv * (p[m] + u[m]);
    }

    // Gives row k the plane at which the point of its path enters the obstacle.
    void set_plane(int k, int obstacle, const double* from, const double* begin, const double* end, double t) const {
        c.gap[k] = plane_on_way(c.obstacles, obstacle, from, begin, end, t, c.normal + 3 * k, c.drift + 3 * k);
        c.obstacle[k] = obstacle;
        c.entry[k] = t;
    }

    // The box of a body's points, at the start of the step and moved by y: middle and radius of the spheres around both.
    struct Ways {
        double from[3], to[3], from_radius, to_radius;
    };
    Ways ways(int body) const {
        double low[6], high[6];
        for (int m = 0; m < 6; ++m) { low[m] = INFINITY; high[m] = -INFINITY; }
        for (int k = c.body_start[body]; k < c.body_start[body + 1]; k += 2) {
            double p[6];
            path(k, p, p + 3);
            for (int m = 0; m < 6; ++m) { low[m] = std::min(low[m], p[m]); high[m] = std::max(high[m], p[m]); }
        }
        Ways w;
        double half[6];
        for (int m = 0; m < 6; ++m) {
            (m < 3 ? w.from[m] : w.to[m - 3]) = 0.5 * (low[m] + high[m]);
            half[m] = 0.5 * (high[m] - low[m]);
        }
        w.from_radius = std::sqrt(dot3(half, half));
        w.to_radius = std::sqrt(dot3(half + 3, half + 3));
        return w;
    }

    // True if no point of the body can come to the obstacle: the paths of any two points differ by both radii at most.
    bool far_away(int obstacle, const Ways& w) const {
        double begin[3], end[3], n[3];
        local_point(c.obstacles.begin + 7 * obstacle, w.from, begin);
        local_point(c.obstacles.end + 7 * obstacle, w.to, end);
        const double distance = distance_to(c.obstacles, obstacle, begin, n);
        for (int m = 0; m < 3; ++m) end[m] -= begin[m];
        return distance > std::sqrt(dot3(end, end)) + 2 * w.from_radius + w.to_radius;
    }

    // Gives points that y moves into an obstacle a row there. Rows come in pairs, of one point each. Returns whether there are such.
    bool sweep() const {
        bool found = false;
        for (int m = 0; m < count && c.obstacle_count > 0; ++m) {
            const Ways w = ways(bodies[m]);
            for (int o = 0; o < c.obstacle_count; ++o)
                if (!far_away(o, w)) found = sweep(bodies[m], o) || found;
        }
        if (found) move_points();
        return found;
    }
    bool sweep(int body, int obstacle) const {
        bool found = false;
        for (int k = c.body_start[body]; k < c.body_start[body + 1]; k += 2) {
            if (c.free[c.corner[CORNERS * k]] == 0) continue;  // of a frozen body
            double from[3], to[3], begin[3], end[3];
            path(k, from, to);
            if (entry_of_way(c.obstacles, obstacle, 0, from, to, begin, end) > 1) continue;
            const double near = entry_time(c.obstacles, obstacle, begin, end, c.thickness[k]);
            take_row(k, obstacle, from, begin, end, near <= 1 ? near : 0);
            found = true;
        }
        return found;
    }

    // One of a pair's rows: the obstacle's own, an empty one, or the one that carries less.
    void take_row(int pair, int obstacle, const double* from, const double* begin, const double* end, double t) const {
        const int k = row_for(c, pair, obstacle);
        const bool same = c.obstacle[k] == obstacle;
        const double *n = c.normal + 3 * k, normal[3] = {n[0], n[1], n[2]}, gap = c.gap[k];
        set_plane(k, obstacle, from, begin, end, t);
        if (same && dot3(normal, c.normal + 3 * k) > SAME_PLANE && std::fabs(gap - c.gap[k]) < 0.1 * c.thickness[k]) {
            c.state[k].hardening *= HARDER;
            return;
        }
        c.state[k].limit = 0;
        c.state[k].hardening = 1;
        std::fill(c.traction + 3 * k, c.traction + 3 * k + 3, 0.0);
    }

    // Sets points that y moves into an obstacle back, to a part of the way.
    void clip() {
        each_site([&](int k) {
            const int node = c.corner[CORNERS * k];
            double from[3], to[3], begin[3], end[3], back[3], earliest = 2;
            if (c.free[node] == 0) return;
            path(k, from, to);
            for (int o = 0; o < c.obstacle_count; ++o) {
                const double t = entry_of_way(c.obstacles, o, 0, from, to, begin, end);
                if (t > 1 || t >= earliest) continue;
                earliest = t;
                for (int m = 0; m < 3; ++m) back[m] = begin[m] + SHORT_OF * t * (end[m] - begin[m]);
                world_point(c.obstacles.end + 7 * o, back, back);
            }
            if (earliest > 1) return;
            ++report.clipped;
            double dv[3];
            for (int m = 0; m < 3; ++m) dv[m] = (back[m] - from[m]) / c.dx_dv - c.predictor[3 * (int64_t)node + m];
            rotated_back(c.rotation + 9 * (int64_t)node, dv, y + 3 * (int64_t)node);
        });
    }

    // Goes on with what an earlier solve of the step has come to. An island that grew counts what its first body has.
    void take_up() {
        result = c.result[bodies[0]];
        report = c.report[bodies[0]];
    }

    // Keeps the forces for the next step, and reports on each body.
    void finish() {
        const bool well = result.status != NOT_FINITE;
        for (int m = 0; m < count; ++m) {
            ContactReport& report = c.report[bodies[m]];
            report = this->report;
            double* reaction = c.reaction + 6 * (int64_t)c.obstacle_count * bodies[m];
            std::fill(reaction, reaction + 6 * c.obstacle_count, 0.0);
        }
        each_range([&](int first, int last) {
            for (int k = first; k < last; ++k) keep(k, well && !rows.empty(k) && c.state[k].force.normal > 0);
        });
        for (int m = 0; m < count; ++m) {
            ContactReport& report = c.report[bodies[m]];
            if (!report.contacts && !report.passes) report.residual = NAN;
            const bool balanced = result.status != CONTACT && !report.clipped;  // else the forces are more than what acted
            if (!balanced && report.work < 0) report.work = 0;
        }
    }

    void keep(int k, bool closed) const {
        const RowState& s = c.state[k];
        double f[3];
        c.force[k] = closed ? s.force.normal : 0;
        for (int m = 0; m < 3; ++m) {
            c.traction[3 * k + m] = closed ? s.force.traction[m] : 0;
            f[m] = c.force[k] * c.normal[3 * k + m] + c.traction[3 * k + m];
        }
        if (!closed) return;
        double displacement[2][3] = {};
        for (int a = 0; a < CORNERS; ++a) {
            const int node = c.corner[CORNERS * k + a];
            if (node < 0) continue;
            double u[3];
            rotated(c.rotation + 9 * (int64_t)node, y + 3 * (int64_t)node, u);
            for (int m = 0; m < 3; ++m)
                displacement[a > 0][m] += c.weight[CORNERS * k + a] * c.dx_dv * (c.predictor[3 * (int64_t)node + m] + u[m]);
        }
        const int body = body_of_row(c, k, false);
        ++c.report[body].contacts;
        c.report[body].work += dot3(f, displacement[0]);
        if (is_pair(c, k)) {
            ++c.report[c.obstacle[k]].contacts;
            c.report[c.obstacle[k]].work += dot3(f, displacement[1]);
        } else {
            react(k, f, c.reaction + 6 * ((int64_t)c.obstacle_count * body + c.obstacle[k]));
        }
    }

    // Force and torque of row k on its obstacle.
    void react(int k, const double* f, double* sum) const {
        double p[3], arm[3];
        rows.at_point(k, loop.x, p);
        for (int m = 0; m < 3; ++m) {
            arm[m] = p[m] + c.state[k].s[m] - c.obstacles.end[7 * c.obstacle[k] + m];
            sum[m] -= f[m];
        }
        sum[3] -= arm[1] * f[2] - arm[2] * f[1];
        sum[4] -= arm[2] * f[0] - arm[0] * f[2];
        sum[5] -= arm[0] * f[1] - arm[1] * f[0];
    }
};

// The step of an island whose rows are detected; of a body alone as without contact where nothing is touched.
static void solve_island(Loop& loop, int island, bool resumes) {
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
        p.solve(!p.rests());
    } else {
        Body& body = loop.body[first];
        const int64_t at = 3 * (int64_t)body.first;
        p.result = pcg(matrix_of(loop, body), loop.b + at, body.factor, body.now, loop.y + at, loop.work + 27 * (int64_t)body.first,
                       !loop.moving[first], &body.correction);
        if (p.result.status != NOT_FINITE) {
            p.move_points();
            const bool acts = p.apply_law(false);
            outside = !p.sweep() && !acts;
            if (!outside) {
                p.leave();
                p.solve(false);
            }
        }
    }
    for (int k = 0; k < ROUNDS && !outside && p.result.status != NOT_FINITE; ++k) {
        outside = !p.sweep();
        if (!outside) p.solve(false);
    }
    if (p.result.status == NOT_FINITE) p.each_entry([&](int64_t k) { p.y[k] = NAN; });  // the kernel `advance` takes the bodies back
    else if (!outside) p.clip();
    for (int m = 0; m < p.count; ++m) {
        p.c.result[p.bodies[m]] = p.result;
        p.c.report[p.bodies[m]] = p.report;
    }
}

// Groups the bodies that have rows with each other, each group's by number. Bodies whose forces are NaN are left alone.
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
        return std::isfinite(dot(3 * (body.last - body.first), loop.b + at, loop.b + at));
    };
    for (int i = 0; c.pair_first >= 0 && i < loop.bodies; ++i) well[i] = finite(i);
    for (int i = 0; c.pair_first >= 0 && i < loop.bodies; ++i) {
        if (!c.near[i]) continue;
        for (int k = c.pair_first + c.body_start[i]; k < c.pair_first + c.body_start[i + 1]; ++k) {
            const int other = c.obstacle[k];
            if (other < 0) continue;
            if (!well[i] || !well[other]) { c.obstacle[k] = -1; continue; }
            const int a = root(i), b = root(other);
            parent[std::max(a, b)] = std::min(a, b);
        }
    }
    c.islands = 0;
    int bodies = 0, rows = 0;
    for (int i = 0; i < loop.bodies; ++i) {
        if (root(i) != i) continue;
        c.island_start[c.islands] = bodies;
        c.island_rows[c.islands++] = rows;
        for (int j = i; j < loop.bodies; ++j) {
            if (root(j) != i) continue;
            c.island[bodies++] = j;
            rows += (c.pair_first >= 0 ? 2 : 1) * (c.body_start[j + 1] - c.body_start[j]);
        }
    }
    c.island_start[c.islands] = bodies;
}

// Solves islands, those of several bodies first. resumes: only those that a sweep has given rows.
static void solve_islands(Loop& loop, bool resumes) {
    Contact& c = *loop.contact;
    auto size = [&](int i) { return c.island_start[i + 1] - c.island_start[i]; };
    auto wanted = [&](int i) {
        bool any = !resumes;
        for (int k = c.island_start[i]; k < c.island_start[i + 1] && !any; ++k) any = c.touched[c.island[k]];
        return any;
    };
    for (int i = 0; i < c.islands; ++i)
        if (size(i) > 1 && wanted(i)) solve_island(loop, i, resumes);
    if (resumes) return;
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
    for (int i = 0; i < c.islands; ++i)
        if (size(i) == 1) solve_island(loop, i, false);
}

// Solves all bodies. Those that pass through each other then get rows where they do, and are solved again.
static void solve_in_contact(Loop& loop) {
    Contact& c = *loop.contact;
    find_islands(loop);
    solve_islands(loop, false);
    for (int k = 0; k < ROUNDS && c.pair_first >= 0; ++k) {
        if (!PairDetection{loop, c, loop.y}.sweep(c.room)) break;
        find_islands(loop);
        solve_islands(loop, true);
    }
    for (int i = 0; i < c.islands; ++i) {
        Passes p(loop, i);
        p.take_up();
        p.finish();
    }
}

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
