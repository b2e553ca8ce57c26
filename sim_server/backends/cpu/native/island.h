// SPDX-License-Identifier: MIT
// Bodies that touch each other, solved as one system: conjugate gradients over an island, preconditioned by each body's own factor (or
// block Jacobi) and, on top, by the rigid motions of its free bodies:
//     z = Q r + (I - Z E^-1 (A Z)^T) P (r - A Z E^-1 Z^T r),   Q = Z E^-1 Z^T,   E = Z^T A Z
// (balanced: Mandel 1993; A-DEF2 of Tang, Nabben, Vuik and Erlangga 2009 is its relative). What the factors of single bodies miss most
// is how a stack moves as a whole: contacts are stiff against it, and each factor sees its own body alone. A is here that of the island
// with the stiffness of its contacts; A Z is kept, so that an application costs no product with A.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "loop.h"

struct IslandNodes {
    const Loop& loop;
    const int32_t* bodies;
    const int32_t count;
    template <class F> double most(F f) const {
        double found = 0;
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            found = std::max(found, f(body.last - body.first, 3 * (int64_t)body.first));
        }
        return std::sqrt(found);
    }
    double peak(const double* a) const { return most([&](int nodes, int64_t at) { return peak2(nodes, a + at); }); }
    double change(const double* a, const double* b) const { return most([&](int nodes, int64_t at) { return peak2(nodes, a + at, b + at); }); }
    void copy(const double* from, double* to) const {
        most([&](int nodes, int64_t at) { std::copy(from + at, from + at + 3 * (int64_t)nodes, to + at); return 0.0; });
    }
};

constexpr int MODES = 6;  // of a body: translations, then rotations about its centre

// Cholesky factor L of the symmetric a (size n, lower half, row stride), in place; false if it is not positive definite.
static bool factorize_dense(double* a, int n, int stride) {
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            const double* p = a + (int64_t)i * stride;
            const double* q = a + (int64_t)j * stride;
            double s = p[j];
#pragma omp simd reduction(- : s)
            for (int k = 0; k < j; ++k) s -= p[k] * q[k];
            if (j < i) a[(int64_t)i * stride + j] = s / q[j];
            else if (!(s > 0)) return false;
            else a[(int64_t)i * stride + i] = std::sqrt(s);
        }
    return true;
}
static void solve_dense(const double* L, int n, int stride, double* x) {
    for (int i = 0; i < n; ++i) {
        double s = x[i];
        for (int k = 0; k < i; ++k) s -= L[(int64_t)i * stride + k] * x[k];
        x[i] = s / L[(int64_t)i * stride + i];
    }
    for (int i = n; i-- > 0;) {
        const double s = x[i] /= L[(int64_t)i * stride + i];
        for (int k = 0; k < i; ++k) x[k] -= L[(int64_t)i * stride + k] * s;
    }
}

struct IslandSolver {
    const Loop& loop;
    Contact& c;
    const int32_t* bodies;
    const int32_t count;
    const Rows& rows;
    int modes = 0;
    double *E, *c1, *c2;                // dense factor; coefficients
    double *z, *p, *q, *x_before;       // of all nodes
    std::vector<BlockCsr>& matrices;
    std::vector<Preconditioner>& single;  // of each body; they refer to `matrices`

    IslandSolver(Loop& loop, Contact& c, const int32_t* bodies, int count, const Rows& rows)
        : loop(loop), c(c), bodies(bodies), count(count), rows(rows), matrices(memory<BlockCsr>()), single(memory<Preconditioner>()) {
        const int64_t n = 3 * (int64_t)loop.nodes;
        z = c.room + 5 * n; p = z + n; q = p + n; x_before = q + n;
        E = c.coarse; c1 = E + (int64_t)c.most_modes * c.most_modes; c2 = c1 + c.most_modes;
    }
    template <class T> static std::vector<T>& memory() {
        static thread_local std::vector<T> kept;
        return kept;
    }

    template <class F> void each_body(F f) const {
        for (int m = 0; m < count; ++m) f(loop.body[bodies[m]], m);
    }
    // The same, bodies side by side: f writes what is its body's alone.
    template <class F> void beside(F f) const {
        each_about_a_body(loop, count, [&](int m) { return bodies[m]; }, [&](int m) { f(loop.body[bodies[m]], m); });
    }
    // Sum of f(body, number), in the order of the bodies whatever the number of threads.
    template <class F> double sum_of(F f) const {
        std::vector<double>& parts = memory<double>();
        parts.resize(count);
        double* const part = parts.data();  // of this thread
        beside([&](Body& body, int m) { part[m] = f(body, m); });
        double sum = 0;
        for (int m = 0; m < count; ++m) sum += part[m];
        return sum;
    }
    template <class F> void each_entry(F f) const {
        each_body([&](const Body& body, int) {
            for (int64_t k = 3 * (int64_t)body.first; k < 3 * (int64_t)body.last; ++k) f(k);
        });
    }
    double norm2(const double* a) const {
        return sum_of([&](const Body& body, int) {
            const int64_t at = 3 * (int64_t)body.first;
            return dot((int)(3 * (int64_t)(body.last - body.first)), a + at, a + at);
        });
    }
    // y = (A + H^T S H) x; returns x . y
    double product(const double* x, double* y) const {
        const double sum = sum_of([&](const Body& body, int) {
            const int64_t at = 3 * (int64_t)body.first;
            return multiply(matrix_of(loop, body), x + at, y + at);
        });
        return sum + rows.add_product(x, y);
    }

    // --- rigid motions ------------------------------------------------------------------------------------------------------------

    // Velocity of a node in the material frame by a body's coefficients: R^T (t + w x (x - x_0)), x_0 its first node.
    void rigid_velocity(const Body& body, int node, const double* m, double* out) const {
        const double *x = loop.x + 3 * (int64_t)node, *o = loop.x + 3 * (int64_t)body.first;
        const double a[3] = {x[0] - o[0], x[1] - o[1], x[2] - o[2]};
        const double v[3] = {m[0] + m[4] * a[2] - m[5] * a[1], m[1] + m[5] * a[0] - m[3] * a[2], m[2] + m[3] * a[1] - m[4] * a[0]};
        rotated_back(c.rotation + 9 * (int64_t)node, v, out);
    }
    // m += Z^T r
    void project(const Body& body, const double* r, double* m) const {
        const double* o = loop.x + 3 * (int64_t)body.first;
        for (int i = body.first; i < body.last; ++i) {
            const double *x = loop.x + 3 * (int64_t)i, a[3] = {x[0] - o[0], x[1] - o[1], x[2] - o[2]};
            double f[3];
            rotated(c.rotation + 9 * (int64_t)i, r + 3 * (int64_t)i, f);
            for (int k = 0; k < 3; ++k) m[k] += f[k];
            m[3] += a[1] * f[2] - a[2] * f[1];
            m[4] += a[2] * f[0] - a[0] * f[2];
            m[5] += a[0] * f[1] - a[1] * f[0];
        }
    }
    // What a row sees of the rigid motion of each of its sides: u = W t + w x lever. lever: (W, lever) of the vertex's body, then of the
    // other one.
    void set_levers() const {
        for (int k = 0; k < rows.actives; ++k) {
            const int r = rows.active[k];
            double* lever = c.lever + 8 * (int64_t)r;
            std::fill(lever, lever + 8, 0.0);
            for (int a = 0; a < CORNERS; ++a) {
                const int node = c.corner[CORNERS * r + a];
                if (node < 0 || c.free[node] == 0) continue;
                const bool other = is_other_side(c, r, a);
                const Body& body = loop.body[body_of_row(c, r, other)];
                const double w = c.weight[CORNERS * r + a], *x = loop.x + 3 * (int64_t)node, *o = loop.x + 3 * (int64_t)body.first;
                double* side = lever + 4 * other;
                side[0] += w;
                for (int m = 0; m < 3; ++m) side[1 + m] += w * (x[m] - o[m]);
            }
        }
    }
    // f(side, first mode) of the sides of a row whose bodies have modes
    template <class F> void each_side(int r, F f) const {
        for (int side = 0; side < (is_pair(c, r) ? 2 : 1); ++side) {
            const int mode = c.mode[body_of_row(c, r, side)];
            if (mode >= 0) f(c.lever + 8 * (int64_t)r + 4 * side, mode);
        }
    }
    static void seen(const double* lever, const double* m, double* u) {
        u[0] += lever[0] * m[0] + m[4] * lever[3] - m[5] * lever[2];
        u[1] += lever[0] * m[1] + m[5] * lever[1] - m[3] * lever[3];
        u[2] += lever[0] * m[2] + m[3] * lever[2] - m[4] * lever[1];
    }
    static void returned(const double* lever, const double* f, double* m) {
        for (int k = 0; k < 3; ++k) m[k] += lever[0] * f[k];
        m[3] += lever[2] * f[2] - lever[3] * f[1];
        m[4] += lever[3] * f[0] - lever[1] * f[2];
        m[5] += lever[1] * f[1] - lever[2] * f[0];
    }

    // Makes A Z of the bodies, without contacts: once a step. Returns the number of modes; 0 where the island has too many.
    static int make_modes(const Loop& loop, Contact& c, const int32_t* bodies, int count) {
        int modes = 0;
        for (int m = 0; m < count; ++m) c.mode[bodies[m]] = -1;
        for (int m = 0; m < count; ++m)
            if (c.unheld[bodies[m]]) modes += MODES;
        if (modes > c.most_modes) return 0;
        modes = 0;
        const Rows none{c, 0, nullptr, 0};
        const IslandSolver self(const_cast<Loop&>(loop), c, bodies, count, none);
        for (int m = 0; m < count; ++m) {
            const Body& body = loop.body[bodies[m]];
            if (!c.unheld[bodies[m]]) continue;
            c.mode[bodies[m]] = modes;
            modes += MODES;
            for (int k = 0; k < MODES; ++k) {
                double unit[MODES] = {};
                unit[k] = 1;
                for (int i = body.first; i < body.last; ++i) self.rigid_velocity(body, i, unit, self.z + 3 * (int64_t)i);
                const int64_t at = 3 * (int64_t)body.first;
                multiply(matrix_of(loop, body), self.z + at, self.q + at);
                for (int64_t i = at; i < 3 * (int64_t)body.last; ++i) c.modes[MODES * i + k] = self.q[i];
            }
        }
        return modes;
    }

    // Makes E of the pass and factorizes it.
    void prepare_modes() {
        modes = 0;
        each_body([&](const Body&, int m) { modes = std::max(modes, c.mode[bodies[m]] + MODES); });
        if (modes < MODES) { modes = 0; return; }
        set_levers();
        for (int i = 0; i < modes; ++i) std::fill(E + (int64_t)i * modes, E + (int64_t)i * modes + modes, 0.0);
        each_body([&](const Body& body, int m) {
            const int first = c.mode[bodies[m]];
            if (first < 0) return;
            for (int k = 0; k < MODES; ++k) {
                double column[MODES] = {};
                for (int64_t i = 3 * (int64_t)body.first; i < 3 * (int64_t)body.last; ++i) z[i] = c.modes[MODES * i + k];
                project(body, z, column);
                for (int l = 0; l < MODES; ++l) E[(int64_t)(first + l) * modes + first + k] = column[l];
            }
        });
        for (int k = 0; k < rows.actives; ++k) {
            const int r = rows.active[k];
            each_side(r, [&](const double* lever, int mode) {
                for (int l = 0; l < MODES; ++l) {
                    double unit[MODES] = {}, u[3] = {0, 0, 0}, f[3];
                    unit[l] = 1;
                    seen(lever, unit, u);
                    Rows::stiff(c.state[r].stiffness, u, f);
                    each_side(r, [&](const double* other, int row) {
                        double m[MODES] = {};
                        returned(other, f, m);
                        for (int j = 0; j < MODES; ++j) E[(int64_t)(row + j) * modes + mode + l] += m[j];
                    });
                }
            });
        }
        if (!factorize_dense(E, modes, modes)) modes = 0;
    }

    // out = r - A Z m
    void subtract_motion(const double* m, const double* r, double* out) const {
        beside([&](const Body& body, int k) {
            const int first = c.mode[bodies[k]];
            for (int64_t i = 3 * (int64_t)body.first; i < 3 * (int64_t)body.last; ++i) {
                double s = r[i];
                for (int l = 0; first >= 0 && l < MODES; ++l) s -= c.modes[MODES * i + l] * m[first + l];
                out[i] = s;
            }
        });
        for (int k = 0; k < rows.actives; ++k) {
            const int row = rows.active[k];
            double u[3] = {0, 0, 0}, f[3];
            each_side(row, [&](const double* lever, int mode) { seen(lever, m + mode, u); });
            Rows::stiff(c.state[row].stiffness, u, f);
            for (int l = 0; l < 3; ++l) f[l] = -f[l];
            rows.scatter(row, f, out);
        }
    }
    // m = (A Z)^T v
    void project_product(const double* v, double* m) const {
        std::fill(m, m + modes, 0.0);
        beside([&](const Body& body, int k) {
            const int first = c.mode[bodies[k]];
            if (first < 0) return;
            for (int64_t i = 3 * (int64_t)body.first; i < 3 * (int64_t)body.last; ++i)
                for (int l = 0; l < MODES; ++l) m[first + l] += c.modes[MODES * i + l] * v[i];
        });
        for (int k = 0; k < rows.actives; ++k) {
            const int row = rows.active[k];
            double u[3] = {0, 0, 0}, f[3];
            rows.gather(row, v, u);
            Rows::stiff(c.state[row].stiffness, u, f);
            each_side(row, [&](const double* lever, int mode) { returned(lever, f, m + mode); });
        }
    }

    // --- preconditioner -----------------------------------------------------------------------------------------------------------

    // The factor that a body wants and has, or null.
    static const Factor* factor_of(const Body& body) { return body.now.kind == CHOLESKY ? body.factor : nullptr; }

    // kind: CHOLESKY or BLOCK_JACOBI, which bodies without a factor have anyway.
    void prepare(int kind) {
        single.clear();
        matrices.clear();
        each_body([&](Body& body, int) { matrices.push_back(matrix_of(loop, body)); });
        each_body([&](Body& body, int m) {
            double* work = loop.work + WORK * (int64_t)body.first;
            const int n = 3 * (body.last - body.first);
            body.correction.in_contact = 0;
            single.push_back({matrices[m], body.factor, BLOCK_JACOBI, work, work + 3 * n, 1, &body.correction});
        });
        set_kinds(kind);
        prepare_modes();
    }
    void set_kinds(int kind) {
        each_body([&](const Body& body, int m) {
            if (kind == CHOLESKY && factor_of(body)) use_factor(m);
            else leave_factor(m);
        });
    }
    void use_factor(int m) {
        single[m].kind = CHOLESKY;
        single[m].prepare();
    }
    // Block Jacobi knows the diagonal parts of contacts.
    void leave_factor(int m) {
        single[m].kind = BLOCK_JACOBI;
        single[m].corrects = false;
        Rows own = rows;
        own.node_first = loop.body[bodies[m]].first;
        BlockCsr A = single[m].A;
        std::vector<int32_t>& list = touching(bodies[m]);
        own.active = list.data();
        own.actives = (int)list.size();
        A.rows = &own;
        invert_diagonal(A, true, single[m].inverse);
    }
    std::vector<int32_t>& touching(int body) const {
        static thread_local std::vector<int32_t> list;
        list.clear();
        for (int k = 0; k < rows.actives; ++k) {
            const int r = rows.active[k];
            if (body_of_row(c, r, false) == body || (is_pair(c, r) && body_of_row(c, r, true) == body)) list.push_back(r);
        }
        return list;
    }

    // to = P^-1 r by the bodies' own. A factor that is not positive definite is left for block Jacobi; false if that is not, either.
    bool apply_single(const double* r, double* to, int& fallbacks) {
        int left = 0;
        const double wrong = sum_of([&](const Body& body, int m) {
            const int64_t at = 3 * (int64_t)body.first;
            const int n = 3 * (body.last - body.first);
            const double norm = std::sqrt(dot(n, r + at, r + at));
            if (norm == 0) { std::fill(to + at, to + at + n, 0.0); return 0; }
            double zr = single[m].apply(r + at, norm, to + at);
            if (!(zr > 0 && zr < INFINITY) && single[m].kind == CHOLESKY) {
                leave_factor(m);
#pragma omp atomic
                ++left;
                zr = single[m].apply(r + at, norm, to + at);
            }
            return zr > 0 && zr < INFINITY ? 0 : 1;
        });
        fallbacks += left;
        return wrong == 0;
    }
    // to = preconditioned r; returns to . r
    double apply(const double* r, double* to, double* scratch, int& fallbacks) {
        if (modes) {
            std::fill(c1, c1 + modes, 0.0);
            beside([&](const Body& body, int m) {
                if (c.mode[bodies[m]] >= 0) project(body, r, c1 + c.mode[bodies[m]]);
            });
            solve_dense(E, modes, modes, c1);
            subtract_motion(c1, r, scratch);
        }
        if (!apply_single(modes ? scratch : r, to, fallbacks)) return NAN;
        if (modes) {
            project_product(to, c2);
            solve_dense(E, modes, modes, c2);
            for (int k = 0; k < modes; ++k) c1[k] -= c2[k];
            beside([&](const Body& body, int m) {
                if (c.mode[bodies[m]] < 0) return;
                for (int i = body.first; i < body.last; ++i) {
                    double v[3];
                    rigid_velocity(body, i, c1 + c.mode[bodies[m]], v);
                    for (int k = 0; k < 3; ++k) to[3 * (int64_t)i + k] += v[k];
                }
            });
        }
        return sum_of([&](const Body& body, int) {
            const int64_t at = 3 * (int64_t)body.first;
            return dot((int)(3 * (int64_t)(body.last - body.first)), to + at, r + at);
        });
    }

    // The bound of the island: the smallest one of its bodies, and what all estimates are to be trusted by.
    struct Bound { double position, trust; };
    Bound bound_of(const SolveSettings& settings) const {
        Bound found{settings.position, OTHER_TRUST};
        each_body([&](const Body& body, int) {
            found.position = std::min(found.position, body.now.position);
            found.trust = std::max(found.trust, body.now.trust);
        });
        return found;
    }

    // Solves from zero; r: its residual at the end.
    SolveResult solve(const double* b, const SolveSettings& settings, double* x, double* r) {
        const double begin = now();
        const double b2 = norm2(b), goal = settings.tolerance * settings.tolerance * b2;
        SolveResult out{0, 0, 0, CONVERGED, settings.kind, 0, 0, 0};
        each_entry([&](int64_t k) { x[k] = 0; r[k] = b[k]; });
        const Bound bound = bound_of(settings);
        const double limit = settings.residual_limit > 0 ? settings.residual_limit * settings.residual_limit * b2 : INFINITY;
        IterateError<IslandNodes> error{{loop, bodies, count}, x, z, x_before, 0};
        auto finish = [&](int status, double r2) {
            error.tell(settings.dx_dv, r2, out);
            out.status = status;
            out.residual = b2 > 0 ? std::sqrt(r2 / b2) : 0;
            out.seconds = now() - begin;
            return out;
        };
        auto true_residual = [&] {
            product(x, r);
            each_entry([&](int64_t k) { r[k] = b[k] - r[k]; });
            return norm2(r);
        };
        if (!std::isfinite(b2)) return finish(NOT_FINITE, b2);
        if (b2 == 0) {
            out.solve_error = 0;
            return finish(CONVERGED, 0);
        }
        prepare(settings.kind);
        double r2 = b2, rz = 0, last_true = INFINITY;
        bool restart = true;
        auto is_enough = [&](bool ahead) {
            return settings.position > 0 && r2 <= limit && may_end(out.kind, r2, b2) && error.is_enough(settings.dx_dv, bound.trust, bound.position, r2, ahead);
        };
        auto ended = [&](bool enough) {  // as in pcg.h
            const double found = r2;
            r2 = true_residual();
            if (r2 <= goal || (enough && r2 <= LOST_DIGITS * found)) return (int)CONVERGED;
            if (!(r2 < 0.25 * last_true)) return (int)MAX_ITERATIONS;
            last_true = r2;
            restart = true;
            return -1;
        };
        for (;;) {
            if (settings.probe > 0 && out.iterations == settings.probe && !out.switched_after) {
                out.kind = out.kind == CHOLESKY ? BLOCK_JACOBI : CHOLESKY;
                out.switched_after = out.iterations;
                out.residual_then = std::sqrt(r2 / b2);
                set_kinds(out.kind);
                restart = true;
            }
            const double zr = apply(r, z, q, out.fallbacks);
            if (!(zr > 0 && zr < INFINITY)) {
                if (!modes) return finish(BREAKDOWN_PRECONDITIONER, true_residual());
                modes = 0;  // the coarse space lost its precision
                restart = true;
                continue;
            }
            error.apply(out.kind, zr, r2);
            if (is_enough(false)) {
                const int status = ended(true);
                if (status >= 0) return finish(status, r2);
                continue;
            }
            const double beta = restart ? 0 : zr / rz;
            each_entry([&](int64_t k) { p[k] = z[k] + beta * p[k]; });
            rz = zr;
            restart = false;
            if (out.iterations == settings.max_iterations) return finish(MAX_ITERATIONS, true_residual());
            const bool spent = settings.budget > 0 ? out.iterations > 0 && now() - begin > settings.budget : out.iterations + 1 == -settings.budget;
            if (spent || (settings.deadline > 0 && out.iterations > 0 && now() > settings.deadline)) return finish(BUDGET, true_residual());
            error.look();
            const double pq = product(p, q);
            ++out.iterations;
            if (!(pq > 0)) return finish(BREAKDOWN_MATRIX, true_residual());
            const double alpha = zr / pq;
            r2 = sum_of([&](const Body& body, int) {
                const int64_t at = 3 * (int64_t)body.first;
                return descend(matrix_of(loop, body), alpha, p + at, q + at, x + at, r + at);
            });
            error.move(alpha);
            const bool enough = is_enough(true);
            if (r2 > goal && !enough) continue;
            const int status = ended(enough);
            if (status >= 0) return finish(status, r2);
        }
    }
};
