// SPDX-License-Identifier: MIT
// A step of a body that touches obstacles, on a CPU (law: kernels/contact_law.cuh; what it is for: docs/contact.md).
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

#include "loop.h"

constexpr double FIRST = 0.02, EARLY = 0.01, SHORT_OF = 0.9;
constexpr double SAME_PLANE = 0.995;  // cosine of the angle between normals
constexpr double HARDER = 10;
constexpr int ROUNDS = 3;

// The passes of one body; allocates nothing.
struct Passes {
    Loop& loop;
    Contact& c;
    Body& body;
    const BodyRows rows;
    BlockCsr A;                          // with the rows
    const double* b;
    double *y, *work;
    double *left, *r, *dy, *before;      // b - A y; with contact; solution of a pass; r before its solve
    const double scale2;                 // i c, of S
    ContactReport report = {0, 0, 0, NAN, 0};
    SolveResult result;
    double given;                        // what |r| is relative to

    Passes(Loop& loop, int index)
        : loop(loop), c(*loop.contact), body(loop.body[index]),
          rows{c, body.first, c.body_start[index], c.body_start[index + 1]},
          A{body.first, body.last, loop.row_start, loop.columns, loop.values, &rows},
          b(loop.b + 3 * (int64_t)body.first), y(loop.y + 3 * (int64_t)body.first), work(loop.work + 27 * (int64_t)body.first),
          scale2(c.dx_dv * c.force_coefficient), result{0, 0, 0, CONVERGED, body.now.kind, 0} {
        const int64_t n = A.size();
        left = c.room + 12 * (int64_t)body.first;
        r = left + n; dy = r + n; before = dy + n;
    }

    template <class F> void each_row(F f) const {
        for (int k = rows.first; k < rows.last; ++k)
            if (!rows.empty(k)) f(k, c.state[k]);
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
    bool apply_law(bool set) const {
        bool any = false;
        each_row([&](int k, RowState& s) {
            const ContactRow row = rows.row(k);
            s.force = contact_force(row, s.s, s.limit, set && s.in_set);
            contact_stiffness(row, s.force, scale2, s.stiffness);
            any = any || rows.acts(k);
        });
        return any;
    }

    // r = left + i H^T f, given = the larger one of |b| and |b + i H^T f|, which is 0 at rest; returns |r|.
    double balance() {
        const int n = A.size();
        std::fill(r, r + n, 0.0);
        each_row([&](int k, RowState& s) {
            double f[3];
            for (int m = 0; m < 3; ++m) f[m] = c.force_coefficient * (s.force.normal * c.normal[3 * k + m] + s.force.traction[m]);
            rows.scatter(k, f, r);
        });
        double all = 0, own = 0, sum = 0;
        for (int k = 0; k < n; ++k) {
            const double f = r[k];
            all += (b[k] + f) * (b[k] + f);
            own += b[k] * b[k];
            r[k] = left[k] + f;
            sum += r[k] * r[k];
        }
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

    // Minimum along dy: 1 where the law does not change along it.
    double line_search(double dot_left, double curvature) const {
        const double start = slope(0, dot_left, curvature);
        double low = 0, high = 1, at_low = start, at_high = slope(1, dot_left, curvature);
        if (!(start < 0)) return 1;  // rounding
        if (std::fabs(at_high) <= 1e-9 * -start) return 1;
        while (at_high < 0 && high < 8) {
            low = high; at_low = at_high;
            high *= 2;
            at_high = slope(high, dot_left, curvature);
        }
        if (at_high < 0) return high;
        for (int k = 0; k < 60 && high - low > 1e-10 * high; ++k) {
            double mid = k % 3 == 2 ? 0.5 * (low + high) : low + (high - low) * at_low / (at_low - at_high);
            if (!(mid > low && mid < high)) mid = 0.5 * (low + high);
            const double here = slope(mid, dot_left, curvature);
            if (here == 0) return mid;
            if (here < 0) { low = mid; at_low = here; } else { high = mid; at_high = here; }
        }
        return 0.5 * (low + high);
    }

    SolveSettings settings_for(double tolerance) const {
        SolveSettings s = body.now;
        s.tolerance = tolerance;
        s.warm_start = 0;
        if (s.probe > 0) s.probe = 0;
        if (s.budget > 0) s.budget = std::max(s.budget - result.seconds, 1e-9);
        if (s.budget < 0) s.budget = std::min(-1.0, s.budget + result.iterations);
        return s;
    }

    // Solves (A + H^T S H) dy = r and moves y by alpha dy, left accordingly. tolerance: of |r|. exactly: alpha is 1.
    void pass(double tolerance, bool exactly) {
        const int n = A.size();
        std::copy(r, r + n, before);
        const SolveResult solved = pcg(A, r, body.factor, settings_for(tolerance), dy, work, false, &body.correction);
        ++report.passes;
        result.seconds += solved.seconds;
        result.iterations += solved.iterations;
        result.fallbacks += solved.fallbacks;
        result.kind = solved.kind;
        result.status = solved.status;
        result.residual = solved.residual;  // of |r|; of what is given at the end of the step
        if (solved.status == NOT_FINITE) return;
        // A dy = r - (residual of the solve) - H^T S H dy: no more product with A. pcg leaves its residual in work.
        std::fill(r, r + n, 0.0);
        rows.add_product(dy, r);
        double dot_left = 0, curvature = 0;
        for (int k = 0; k < n; ++k) {
            r[k] = before[k] - work[k] - r[k];  // A dy
            dot_left += dy[k] * left[k];
            curvature += dy[k] * r[k];
        }
        each_row([&](int k, RowState& s) {
            double u[3] = {0, 0, 0};
            rows.gather(k, dy, u);
            for (int m = 0; m < 3; ++m) s.step[m] = c.dx_dv * u[m];
        });
        const double alpha = exactly ? 1 : line_search(dot_left, curvature);
        for (int k = 0; k < n; ++k) {
            y[k] += alpha * dy[k];
            left[k] -= alpha * r[k];
        }
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
            const double goal = body.now.tolerance * given;
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
            spent = result.status == BUDGET;
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

    // Begins with the better one of the last solution and zero; left = b - A y.
    void start() {
        const int n = A.size();
        auto zero = [&] {
            std::fill(y, y + n, 0.0);
            std::copy(b, b + n, left);
        };
        if (!body.now.warm_start) { zero(); move_points(); return; }
        BlockCsr plain = A;
        plain.rows = nullptr;
        residual(plain, b, y, left);
        const double warm = size_at();
        std::copy(y, y + n, dy);
        std::copy(left, left + n, before);
        zero();
        if (size_at() <= warm || !(warm < INFINITY)) return;
        std::copy(dy, dy + n, y);
        std::copy(before, before + n, left);
        move_points();
    }

    // True if the law holds where it begins, so that rows that would be hit without it need not count as closed.
    bool rests() {
        apply_law(false);
        const double size = balance();
        return size <= c.tolerance * given;
    }

    // Point of a site, at the start of the step and moved by y. Both rows of a node have the same.
    void path(int k, double* from, double* to) const {
        double u[3] = {0, 0, 0}, p[3];
        rows.at_point(k, loop.x, from);
        rows.at_point(k, c.predictor, p);
        rows.gather(k, y, u);
        for (int m = 0; m < 3; ++m) to[m] = from[m] + c.dx_dv * (p[m] + u[m]);
    }

    // The part of the way at which the point of row k enters the obstacle; 2: it does not.
    double swept(int obstacle, double inflate, const double* from, const double* to, double* begin, double* end) const {
        local_point(c.obstacles.begin + 7 * obstacle, from, begin);
        local_point(c.obstacles.end + 7 * obstacle, to, end);
        double n[3], way[3] = {end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]};
        const double distance = distance_to(c.obstacles, obstacle, begin, n);
        if (!(distance > 0) || distance - inflate > std::sqrt(dot3(way, way))) return 2;
        return entry_time(c.obstacles, obstacle, begin, end, inflate);
    }

    // Gives row k the plane at which the point of its path enters the obstacle.
    void set_plane(int k, int obstacle, const double* from, const double* begin, const double* end, double t) const {
        double p[3], n[3], q[3], at_begin[3], at_end[3], *normal = c.normal + 3 * k, *drift = c.drift + 3 * k;
        for (int m = 0; m < 3; ++m) p[m] = begin[m] + t * (end[m] - begin[m]);
        const double distance = distance_to(c.obstacles, obstacle, p, n);
        for (int m = 0; m < 3; ++m) q[m] = p[m] - distance * n[m];
        world_point(c.obstacles.begin + 7 * obstacle, q, at_begin);
        world_point(c.obstacles.end + 7 * obstacle, q, at_end);
        world_vector(c.obstacles.end + 7 * obstacle, n, normal);
        c.gap[k] = 0;
        for (int m = 0; m < 3; ++m) {
            drift[m] = at_end[m] - at_begin[m];
            c.gap[k] += normal[m] * (from[m] - at_end[m]);
        }
        c.obstacle[k] = obstacle;
        c.entry[k] = t;
    }

    // The box of the body's points, at the start of the step and moved by y: middle and radius of the spheres around both.
    struct Ways {
        double from[3], to[3], from_radius, to_radius;
    };
    Ways ways() const {
        double low[6], high[6];
        for (int m = 0; m < 6; ++m) { low[m] = INFINITY; high[m] = -INFINITY; }
        for (int k = rows.first; k < rows.last; k += 2) {
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
        const Ways w = ways();
        for (int o = 0; o < c.obstacle_count; ++o) {
            if (far_away(o, w)) continue;
            for (int k = rows.first; k < rows.last; k += 2) {
                double from[3], to[3], begin[3], end[3];
                path(k, from, to);
                if (swept(o, 0, from, to, begin, end) > 1) continue;
                const double near = entry_time(c.obstacles, o, begin, end, c.thickness[k]);
                take_row(k, o, from, begin, end, near <= 1 ? near : 0);
                found = true;
            }
        }
        if (found) move_points();
        return found;
    }

    // One of a pair's rows: the obstacle's own, an empty one, or the one that carries less.
    void take_row(int pair, int obstacle, const double* from, const double* begin, const double* end, double t) const {
        int k = pair;
        if (c.obstacle[pair] != obstacle) {
            const bool other = c.obstacle[pair + 1] == obstacle || rows.empty(pair + 1);
            k += other || (!rows.empty(pair) && c.state[pair + 1].force.normal < c.state[pair].force.normal);
        }
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
        for (int k = rows.first; k < rows.last; k += 2) {
            const int node = c.corner[3 * k];
            double from[3], to[3], begin[3], end[3], back[3], earliest = 2;
            if (c.free[node] == 0) continue;
            path(k, from, to);
            for (int o = 0; o < c.obstacle_count; ++o) {
                const double t = swept(o, 0, from, to, begin, end);
                if (t > 1 || t >= earliest) continue;
                earliest = t;
                for (int m = 0; m < 3; ++m) back[m] = begin[m] + SHORT_OF * t * (end[m] - begin[m]);
                world_point(c.obstacles.end + 7 * o, back, back);
            }
            if (earliest > 1) continue;
            ++report.clipped;
            double dv[3];
            for (int m = 0; m < 3; ++m) dv[m] = (back[m] - from[m]) / c.dx_dv - c.predictor[3 * (int64_t)node + m];
            rotated_back(c.rotation + 9 * (int64_t)node, dv, y + 3 * (node - body.first));
        }
    }

    // Keeps the forces for the next step, and what they did in this one. index: of the body.
    void finish(int index) {
        double* reaction = c.reaction + 6 * (int64_t)c.obstacle_count * index;
        std::fill(reaction, reaction + 6 * c.obstacle_count, 0.0);
        const bool well = result.status != NOT_FINITE;
        for (int k = rows.first; k < rows.last; ++k) {
            const RowState& s = c.state[k];
            const bool closed = well && !rows.empty(k) && s.force.normal > 0;
            c.force[k] = closed ? s.force.normal : 0;
            double f[3], at[3], p[3], arm[3];
            for (int m = 0; m < 3; ++m) {
                c.traction[3 * k + m] = closed ? s.force.traction[m] : 0;
                f[m] = c.force[k] * c.normal[3 * k + m] + c.traction[3 * k + m];
            }
            if (!closed) continue;
            ++report.contacts;
            report.work += dot3(f, s.s);
            rows.at_point(k, loop.x, p);
            double* sum = reaction + 6 * c.obstacle[k];
            for (int m = 0; m < 3; ++m) {
                at[m] = p[m] + s.s[m];
                arm[m] = at[m] - c.obstacles.end[7 * c.obstacle[k] + m];
                sum[m] -= f[m];
            }
            sum[3] -= arm[1] * f[2] - arm[2] * f[1];
            sum[4] -= arm[2] * f[0] - arm[0] * f[2];
            sum[5] -= arm[0] * f[1] - arm[1] * f[0];
        }
        if (!report.contacts && !report.passes) report.residual = NAN;
        const bool balanced = result.status != CONTACT && !report.clipped;  // else the forces are more than what acted
        if (!balanced && report.work < 0) report.work = 0;
        c.report[index] = report;
    }
};

// The step of a body whose rows are detected: as without contact where nothing is touched.
static SolveResult solve_in_contact(Loop& loop, int index) {
    Passes p(loop, index);
    const Body& body = loop.body[index];
    const int64_t at = 3 * (int64_t)body.first, n = p.A.size();
    bool outside = false;  // y was swept and enters nothing
    if (p.choose_set()) {
        p.start();
        p.solve(!p.rests());
    } else {
        BlockCsr A = p.A;
        A.rows = nullptr;
        p.result = pcg(A, loop.b + at, body.factor, body.now, p.y, p.work, !loop.moving[index], &loop.body[index].correction);
        if (p.result.status != NOT_FINITE) {
            p.move_points();
            const bool acts = p.apply_law(false);
            outside = !p.sweep() && !acts;
            if (!outside) {
                residual(A, p.b, p.y, p.left);
                p.solve(false);
            }
        }
    }
    for (int k = 0; k < ROUNDS && !outside && p.result.status != NOT_FINITE; ++k) {
        outside = !p.sweep();
        if (!outside) p.solve(false);
    }
    if (p.result.status == NOT_FINITE) std::fill(p.y, p.y + n, NAN);  // the kernel `advance` takes the body back
    else if (!outside) p.clip();
    p.finish(index);
    return p.result;
}

// Adds the stiffness of contacts that carried force in the last step to a copy of a body's blocks, so that a factor made from it knows
// them. A row that slid counts with its normal stiffness alone.
static void add_contacts(const Loop& loop, const Body& body, double* target) {
    const Contact& c = *loop.contact;
    const int index = (int)(&body - loop.body), begin = loop.row_start[body.first];
    const BodyRows rows{c, body.first, c.body_start[index], c.body_start[index + 1]};
    for (int k = rows.first; k < rows.last; ++k) {
        if (rows.empty(k) || !(c.force[k] > 0)) continue;
        ContactForce f = {c.force[k], {0, 0, 0}, 0, true};
        const double* t = c.traction + 3 * k;
        if (dot3(t, t) < 0.98 * square(c.friction[k] * c.force[k])) f.slip = 1;
        double s[6];
        c.state[k].hardening = 1;
        contact_stiffness(rows.row(k), f, c.dx_dv * c.force_coefficient, s);
        rows.add_blocks(k, s, [&](int i, int j) -> double* {
            for (int m = loop.row_start[i]; m < loop.row_start[i + 1]; ++m)
                if (loop.columns[m] == j) return target + 9 * (int64_t)(m - begin);
            return nullptr;
        });
    }
}
