// SPDX-License-Identifier: MIT
// Low-rank correction of a factor for changes of blocks of A since its matrix. Grabs of clients (effects/touch.py) and contacts with
// obstacles begin and end from one step to the next; a factor lacks them, or has them too long, until one arrives that was made of a
// later matrix. With U the columns of the identity at the nodes concerned and C the difference of the blocks on and between them,
//     (P + U C U')^-1 = L^-T (I - V W V') L^-1,    V = L^-1 U,  W = (C^-1 + V'V)^-1,
// the Sherman-Morrison-Woodbury formula between the two triangular solves. V has entries only in the supernodes on the paths
// from these nodes to the root, so that it costs a few applications of the factor. With V'V = K K' and
// G = I + K'C K,  W = C - C K G^-1 K'C  for C of any sign, including 0; the result is positive definite if and only
// if G is. Springs are multiples of the identity, the same in all frames, so the warp does not change them; blocks of contacts are in the
// material frame, as A is, each in that of its own step.
//
// The diagonal of an older matrix follows from a list of changes, read backwards to the step of the factor; so a factor made
// with the spring is not corrected for it. What the matrix of a step had of contacts is remembered as it is.
// (Hager, Updating the inverse of a matrix, SIAM Review 31, 1989.)
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "bsr.h"
#include "cut_nodes.h"
#include "local_refresh.h"
#include "supernodal.h"

struct Factor {
    const Pattern* pattern;
    const void* values;
    int64_t step;      // of the matrix it was made from
    int32_t bytes;     // of a value: 4 or 8
};

struct Change {        // of the diagonal of a node
    int64_t step;      // whose matrix is the first with the new value
    double before;     // the old one [kg]
    int32_t node;
};

struct KnownContact {  // a contact's part of a block of A
    int64_t step;      // whose copy for a worker would have it
    double block[9];   // material frame [kg]
    int32_t node, other;  // row and column, node <= other; node -1: the body has contacts that are not noted
};

struct Correction {
    int32_t capacity;       // most nodes corrected at once; 0: off
    int32_t history;        // changes kept in the ring
    int32_t nodes;          // of the body
    int32_t count;          // nodes of V; 0: there is no V
    int32_t supernodes;     // of V
    int32_t usable;         // W exists and the corrected factor is positive definite
    int32_t used;           // nodes corrected in the last solve with a factor
    int32_t missed;         // 1: changes that matter are not corrected
    int64_t changes;        // so far
    int64_t forgotten;      // step of the newest change that has left the ring
    int64_t step;           // of the factor that `then` and V are for
    const Factor* factor;   // likewise
    const double* diagonal; // (nodes,) of A as assembled now [kg]
    const double* block;    // (nodes, 6) upper triangles of the nodes' own blocks without it [kg]; null: to be read from A
    double *last, *then;    // (nodes,) of the last step; of the matrix of the factor in use
    Change* change;         // (history,) the ring
    int32_t* node;          // (capacity,) of V
    int32_t* supernode;     // (3 nodes,) of V, ascending
    uint8_t* marked;        // (3 nodes,)
    double* delta;          // C as W was made with, (3 count, 3 count) in room for (3 capacity, 3 capacity) [kg]
    double* small;          // 4 width^2 + 2 width
    void* columns;          // (3 nodes, width) V, in the values' type, only rows of its supernodes
    double spent;           // on V and W, not yet charged to a solve, as much as reading so many bytes of A
    int32_t touches;        // most entries of `touch` and of each of `link_*`; 0: there is no contact
    int32_t in_contact;     // 1: touch_now and link_now are what A has beside its values
    int32_t touch_known;    // 1: touch_then and link_then are what the matrix of the factor in use had there
    int32_t links_now, links_then;
    int64_t touched;        // entries of `touch` so far
    int64_t touch_lost;     // step of the newest one that has left the ring
    KnownContact* touch;    // (touches,) the ring
    double *touch_now, *touch_then;  // (nodes, 9) own blocks
    KnownContact *link_now, *link_then;  // blocks between two nodes
    CutNodes* cut;          // nodes that may lose elements, or null
    KnownDiagonals* known;  // of earlier matrices, or null: factors are never refreshed
};

constexpr int MAX_CORRECTED = 64;              // nodes
constexpr double NOTHING = 0.004;              // relative to the node's own block: smaller changes are ignored
constexpr double WEAK = 0.2, WEAK_EACH = 0.02;  // likewise, for the sum of all changes and their mean: below, no correction
// Larger changes, in blocks, are corrected as this much: one cluster of eigenvalues remains, and rounding stays small. Of a larger
// spring that has gone 1e-4 remains.
constexpr double STIFF = 1e5;
constexpr double LEAST = 1e-6;  // pivot of G
// What V costs for a byte of L and for each column, V'V for each of its entries and columns, and W for each of d^3, where to read a byte
// of A is 1.
constexpr double PANEL_BYTES = 50, COLUMN_BYTES = 0.5, GRAM_BYTES = 2, INNER_BYTES = 15;

// Number of columns of V, padded with zeros to a whole number of vectors.
inline int width_of(int nodes) { return (3 * nodes + 7) / 8 * 8; }

// Cholesky factor K of a = K K', lower, in place; false if a pivot is below `least`.
static bool cholesky(double* a, int d, int stride, double least) {
    for (int i = 0; i < d; ++i) {
        for (int j = 0; j <= i; ++j) {
            double s = a[i * stride + j];
            for (int k = 0; k < j; ++k) s -= a[i * stride + k] * a[j * stride + k];
            if (j < i) a[i * stride + j] = s / a[j * stride + j];
            else if (!(s > least)) return false;
            else a[i * stride + i] = std::sqrt(s);
        }
    }
    return true;
}

// Forward substitution y = L^-1 y of many right-hand sides within a panel, and the update of the rows below.
template <class T>
static void forward_rows(const Panel<T>& L, const int32_t* rows, int width, T* y) {
    const T* own = y + (int64_t)rows[0] * width;
    for (int r = 0; r < L.height; ++r) {
        T* row = y + (int64_t)rows[r] * width;
        const int end = std::min(r, L.columns);
        for (int k = 0; k < end; ++k) {
            const T l = L.column(k)[r], *x = own + (int64_t)k * width;
#pragma omp simd
            for (int j = 0; j < width; ++j) row[j] -= l * x[j];
        }
        if (r < L.columns) {
            const T inverse = 1 / L.column(r)[r];
            for (int j = 0; j < width; ++j) row[j] *= inverse;
        }
    }
}

// Applies a Correction in one solve; allocates nothing.
struct Corrected {
    Correction& c;
    const BlockCsr& A;
    const Factor& factor;

    const Pattern& pattern() const { return *factor.pattern; }
    int width() const { return width_of(c.count); }
    double *gram() const { return c.small; }
    double *inner() const { return c.small + (int64_t)width() * width(); }

    // Updates W to the present diagonal; true if there is something to correct.
    bool prepare() {
        if (c.factor != &factor || c.step != factor.step) take_factor();
        c.used = 0;
        c.missed = c.count < 0;
        if (!choose()) return false;
        const int64_t size = 9 * (int64_t)c.count * c.count;
        double* present = inner() + (int64_t)width() * width();
        differences(present);
        const bool same = std::equal(present, present + size, c.delta);
        if (!same) std::copy(present, present + size, c.delta), c.usable = make_inner();
        if (!same) c.spent += INNER_BYTES * (27.0 * c.count * c.count * c.count);
        if (c.usable) c.used = c.count;
        c.missed = !c.usable;
        return c.usable;
    }

    // y = L^-1 r  ->  (I - V W V') y
    template <class T>
    void between(T* y) const {
        const int w = width(), d = 3 * c.count;
        const T* columns = (const T*)c.columns;
        double *t = c.small + 4 * (int64_t)w * w, *u = t + w;
        T* rounded = (T*)u;
        for (int j = 0; j < w; ++j) t[j] = 0;
        over_rows([&](int row) {
            const T *v = columns + (int64_t)row * w, f = y[row];
#pragma omp simd
            for (int j = 0; j < w; ++j) t[j] += (double)v[j] * f;
        });
        const double* W = inner();
        for (int i = 0; i < w; ++i) {
            double s = 0;
            for (int j = 0; i < d && j < d; ++j) s += W[i * w + j] * t[j];
            rounded[i] = (T)s;
        }
        over_rows([&](int row) {
            const T* v = columns + (int64_t)row * w;
            T s = 0;
#pragma omp simd reduction(+ : s)
            for (int j = 0; j < w; ++j) s += v[j] * rounded[j];
            y[row] -= s;
        });
    }

private:
    template <class F>
    void over_rows(F f) const {
        for (int k = 0; k < c.supernodes; ++k) {
            const int s = c.supernode[k];
            for (int row = pattern().super_start[s]; row < pattern().super_start[s + 1]; ++row) f(row);
        }
    }

    // Reconstructs the diagonal of the factor's matrix from the present one by undoing the changes since. If some have left the
    // ring nothing is corrected until the next factor.
    void take_factor() {
        c.factor = &factor;
        c.step = factor.step;
        c.count = c.usable = 0;
        std::copy(c.last, c.last + c.nodes, c.then);
        for (int64_t k = c.changes; k > std::max<int64_t>(0, c.changes - c.history); --k) {
            const Change& change = c.change[(k - 1) % c.history];
            if (change.step <= factor.step) break;
            c.then[change.node] = change.before;
        }
        if (c.forgotten > factor.step) std::copy(c.diagonal, c.diagonal + c.nodes, c.then), c.count = -1;
        if (c.touches) take_touches();
    }

    // What the factor knows of contacts.
    void take_touches() {
        c.touch_known = c.touch_lost < factor.step;
        std::fill(c.touch_then, c.touch_then + 9 * (int64_t)c.nodes, 0.0);
        c.links_then = 0;
        for (int64_t k = c.touched; k > std::max<int64_t>(0, c.touched - c.touches); --k) {
            const KnownContact& touch = c.touch[(k - 1) % c.touches];
            if (touch.step < factor.step) break;
            if (touch.step > factor.step) continue;
            if (touch.node < 0) c.touch_known = 0;
            else if (touch.node < touch.other) c.link_then[c.links_then++] = touch;
            else for (int m = 0; m < 9; ++m) c.touch_then[9 * (int64_t)touch.node + m] += touch.block[m];
        }
    }

    bool contacts() const { return c.in_contact && c.touch_known; }

    // Difference of a node's block from that of the factor's matrix, symmetric; diagonal: its part from springs. Returns its size.
    double difference(int node, double diagonal, double* out) const {
        const double *now = c.touch_now + 9 * (int64_t)node, *then = c.touch_then + 9 * (int64_t)node;
        double size = 0;
        for (int i = 0; i < 3; ++i)
            for (int j = i; j < 3; ++j) {
                const double d = (contacts() ? now[3 * i + j] - then[3 * i + j] : 0) + (i == j ? diagonal : 0);
                out[3 * i + j] = out[3 * j + i] = d;
                size = std::fmax(size, std::fabs(d));
            }
        return size;
    }

    // C
    void differences(double* out) const {
        const int d = 3 * c.count;
        std::fill(out, out + (int64_t)d * d, 0.0);
        for (int k = 0; k < c.count; ++k) {
            double own[9];
            difference(c.node[k], bounded(c.node[k]), own);
            for (int m = 0; m < 9; ++m) out[(3 * k + m / 3) * d + 3 * k + m % 3] = own[m];
        }
        auto place = [&](int node) { return (int)(std::find(c.node, c.node + c.count, node) - c.node); };
        auto add = [&](const KnownContact* link, int links, double sign) {
            for (int k = 0; k < links; ++k) {
                const int i = place(link[k].node), j = i < c.count ? place(link[k].other) : i;
                if (i == c.count || j == c.count) continue;
                for (int m = 0; m < 9; ++m) {
                    const int row = 3 * i + m / 3, column = 3 * j + m % 3;
                    out[row * d + column] = out[column * d + row] += sign * link[k].block[m];
                }
            }
        };
        if (!contacts()) return;
        add(c.link_now, c.links_now, 1);
        add(c.link_then, c.links_then, -1);
    }

    const double* block(int node) const {
        int k = A.row_start[A.first + node];
        while (A.columns[k] != A.first + node) ++k;
        return A.values + 9 * (int64_t)k;
    }
    double own(int node) const {
        if (const double* k = c.block ? c.block + 6 * (int64_t)node : nullptr) return (k[0] + k[3] + k[5]) / 3 + c.diagonal[node];
        const double* a = block(node);
        return (a[0] + a[4] + a[8]) / 3;
    }

    double bounded(int node) const {
        const double delta = c.diagonal[node] - c.then[node], rest = own(node) - std::fmax(delta, 0);
        const double most = STIFF * std::ldexp(1.0, std::ilogb(rest));  // the same from step to step
        return delta > most ? most : delta < -most ? delta - 1e-4 * delta : delta;
    }

    // Chooses the nodes of V; present ones stay while no others are needed, as springs at their force limit come and go. False: too
    // many nodes, or changes too small.
    bool choose() {
        if (c.count < 0) return false;
        int changed = 0, others = 0, chosen[MAX_CORRECTED];
        double together = 0;
        for (int i = 0; i < c.nodes; ++i) {
            const double spring = c.diagonal[i] - c.then[i];
            double delta = spring, block[9];
            if (contacts()) delta = difference(i, spring, block);
            if (delta == 0) continue;
            const double share = std::fabs(delta) / (own(i) - std::fmax(spring, 0));
            if (!(share > NOTHING)) continue;
            together += share;
            others += std::find(c.node, c.node + c.count, i) == c.node + c.count;
            if (changed < c.capacity) chosen[changed] = i;
            ++changed;
        }
        c.missed = changed > c.capacity && together >= WEAK;
        if (changed > c.capacity || together < WEAK || together < WEAK_EACH * changed) return false;
        if (others) {
            if (contacts() && others + c.count <= c.capacity) changed = with_present(chosen, changed);
            std::copy(chosen, chosen + changed, c.node);
            c.count = changed;
            std::fill(c.delta, c.delta + 9 * (int64_t)changed * changed, NAN);
            if (factor.bytes == 4) make_columns<float>();
            else make_columns<double>();
            c.spent += column_bytes();
        }
        return true;
    }

    // Keeps the nodes of V, as contacts come and go. Returns how many are chosen then.
    int with_present(int* chosen, int changed) const {
        const int first = changed;
        for (int k = 0; k < c.count; ++k)
            if (std::find(chosen, chosen + first, c.node[k]) == chosen + first) chosen[changed++] = c.node[k];
        return changed;
    }

    // Supernodes that L^-1 U reaches, ascending.
    void reach() {
        const Pattern& p = pattern();
        const int32_t* end = p.super_start + p.supernodes + 1;
        auto of = [&](int row) { return (int)(std::upper_bound(p.super_start, end, row) - p.super_start) - 1; };
        std::fill(c.marked, c.marked + p.supernodes, 0);
        for (int i = 0; i < p.size; ++i)
            if (std::find(c.node, c.node + c.count, p.permutation[i] / 3) != c.node + c.count) c.marked[of(i)] = 1;
        c.supernodes = 0;
        for (int s = 0; s < p.supernodes; ++s) {
            if (!c.marked[s]) continue;
            c.supernode[c.supernodes++] = s;
            for (int64_t k = p.row_start[s] + p.super_start[s + 1] - p.super_start[s]; k < p.row_start[s + 1]; ++k)
                c.marked[of(p.rows[k])] = 1;
        }
    }

    double column_bytes() const {
        const Pattern& p = pattern();
        double entries = 0, rows = 0;
        for (int k = 0; k < c.supernodes; ++k) {
            const int s = c.supernode[k];
            const double n = p.super_start[s + 1] - p.super_start[s], h = p.row_start[s + 1] - p.row_start[s];
            entries += n * (h - 0.5 * n);
            rows += n;
        }
        return (PANEL_BYTES + COLUMN_BYTES * width()) * factor.bytes * entries + GRAM_BYTES * rows * width() * width();
    }

    template <class T>
    void make_columns() {
        const Pattern& p = pattern();
        const int w = width();
        T* V = (T*)c.columns;
        reach();
        over_rows([&](int row) {
            T* v = V + (int64_t)row * w;
            std::fill(v, v + w, T(0));
            const int dof = p.permutation[row], k = (int)(std::find(c.node, c.node + c.count, dof / 3) - c.node);
            if (k < c.count) v[3 * k + dof % 3] = 1;
        });
        for (int k = 0; k < c.supernodes; ++k) {
            const int s = c.supernode[k];
            const int64_t start = p.row_start[s];
            Panel<T> L{(const T*)factor.values + p.value_start[s], p.super_start[s + 1] - p.super_start[s],
                       (int)(p.row_start[s + 1] - start)};
            forward_rows(L, p.rows + start, w, V);
        }
        double* S = gram();
        std::fill(S, S + (int64_t)w * w, 0.0);
        over_rows([&](int row) {
            const T* v = V + (int64_t)row * w;
            for (int i = 0; i < 3 * c.count; ++i) {
                const double f = v[i];
                const int end = (i + 8) / 8 * 8;  // the lower triangle, in whole vectors
#pragma omp simd
                for (int j = 0; j < end; ++j) S[i * w + j] += f * v[j];
            }
        });
    }

    // Blocks of C that are not zero, or on its diagonal.
    struct Blocks {
        int start[MAX_CORRECTED + 1];
        uint8_t column[MAX_CORRECTED * MAX_CORRECTED];
    };
    void find_blocks(Blocks& found) const {
        const int d = 3 * c.count;
        int count = 0;
        for (int i = 0; i < c.count; ++i) {
            found.start[i] = count;
            for (int j = 0; j < c.count; ++j) {
                bool any = i == j;
                for (int m = 0; m < 9 && !any; ++m) any = c.delta[(3 * i + m / 3) * d + 3 * j + m % 3] != 0;
                if (any) found.column[count++] = (uint8_t)j;
            }
        }
        found.start[c.count] = count;
    }

    // W from V'V and C.
    bool make_inner() {
        const int w = width(), d = 3 * c.count;
        double *W = inner(), *K = W + (int64_t)w * w, *G = K + (int64_t)w * w, product[3 * MAX_CORRECTED];
        const double* C = c.delta;
        Blocks blocks;
        find_blocks(blocks);
        auto each_block = [&](int i, auto f) {
            for (int k = blocks.start[i]; k < blocks.start[i + 1]; ++k) f(3 * blocks.column[k]);
        };
        std::copy(gram(), gram() + (int64_t)w * w, K);
        if (!cholesky(K, d, w, 0)) return false;
        for (int i = 0; i < d; ++i)
            for (int j = 0; j < i; ++j) K[j * w + i] = 0;
        std::fill(G, G + (int64_t)w * w, 0.0);
        for (int i = 0; i < d; ++i) {
            G[i * w + i] += 1;
            std::fill(product, product + d, 0.0);  // row i of C K
            int end = 0;
            each_block(i / 3, [&](int j) {
                const double *f = C + i * d + j, *k = K + j * w;
                end = j + 3;
                for (int a = 0; a < end; ++a) product[a] += f[0] * k[a] + f[1] * k[w + a] + f[2] * k[2 * w + a];
            });
            for (int a = 0; a < end; ++a)
                for (int b = 0; b <= i; ++b) G[a * w + b] += product[a] * K[i * w + b];
        }
        if (!cholesky(G, d, w, LEAST)) return false;
        // K <- B = M^-1 K' C with G = M M', row after row; then W = C - B' B
        for (int i = 0; i < d; ++i)
            for (int j = 0; j < i; ++j) std::swap(K[i * w + j], K[j * w + i]);
        for (int i = 0; i < d; ++i) {
            std::fill(product, product + d, 0.0);
            for (int k = 0; k < c.count; ++k) {
                const double *x = K + i * w + 3 * k, *f = C + 3 * k * d;
                each_block(k, [&](int j) {
                    for (int m = j; m < j + 3; ++m) product[m] += x[0] * f[m] + x[1] * f[d + m] + x[2] * f[2 * d + m];
                });
            }
            std::copy(product, product + d, K + i * w);
            for (int k = 0; k < i; ++k) {
                const double f = G[i * w + k];
                for (int j = 0; j < d; ++j) K[i * w + j] -= f * K[k * w + j];
            }
            for (int j = 0; j < d; ++j) K[i * w + j] /= G[i * w + i];
        }
        std::fill(W, W + (int64_t)w * w, 0.0);
        for (int i = 0; i < d; ++i)
            for (int j = 0; j < d; ++j) W[i * w + j] = C[i * d + j];
        for (int k = 0; k < d; ++k)
            for (int i = 0; i < d; ++i) {
                const double f = K[k * w + i];
                for (int j = 0; j < d; ++j) W[i * w + j] -= f * K[k * w + j];
            }
        return true;
    }

};

// Records changes of the diagonal after the launches of a step.
static void note_changes(Correction& c, int64_t step, bool first) {
    if (c.capacity == 0) return;
    if (first) std::copy(c.diagonal, c.diagonal + c.nodes, c.last);
    for (int i = 0; i < c.nodes; ++i) {
        if (c.diagonal[i] == c.last[i]) continue;
        Change& change = c.change[c.changes % c.history];
        if (c.changes >= c.history) c.forgotten = change.step;
        ++c.changes;
        change = Change{step, c.last[i], i};
        c.last[i] = c.diagonal[i];
    }
}
