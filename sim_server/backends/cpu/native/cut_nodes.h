// SPDX-License-Identifier: MIT
// Keeps a factor useful after elements were removed (effects/cutting.py). With T the nodes that lost or got back elements since the
// factor's matrix and their neighbours, and S the inverse of A on T, the symmetric multiplicative Schwarz method
//     z = S r + (I - S A) P^-1 (I - A S) r
// is exact on T and positive definite if P is. Nodes that were copied since, where the body was split along faces, have rows that P
// knows nothing of: M P^-1 M^T takes its place, M the map by which they move as the nodes did of which they are copies. On the motion
// that they have in common this is P^-1 of the whole body, and S is for what sets them apart. Nodes without elements, whose rows of A are the identity, are set apart: z = 0 there.
// S is a Cholesky factor with an envelope, in the order of Cuthill and McKee, made in each solve, since A changes. Where that costs
// too much (ENOUGH_FOR_CUTS), the neighbours are left out, then all of T: only the nodes without elements are set apart, and the
// inverses of their own blocks are added for copies and what they are copies of.
// (Smith, Bjorstad and Gropp, Domain Decomposition, 1996, section 1.3; George and Liu, Computer Solution of Large Sparse Positive
// Definite Systems, 1981, chapter 4.)
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "bsr.h"

struct CutNodes {          // of a body whose elements may be removed
    int32_t nodes;         // of the body
    int32_t count;         // of T in the solve under way; 0: T is left out
    int32_t wanted;        // of T, whether or not it is left out
    int32_t gone;          // nodes without elements
    int64_t capacity;      // entries of `envelope`
    double start_time, dt; // of the run [s]
    const double* at_rest;     // (nodes,) 1 at nodes without elements
    const double* changed_at;  // (nodes,) when the node lost or got back an element [s]
    const double* free;        // (nodes,) 0 at fixed nodes
    const int32_t* origin;     // (nodes,) node of the scene that each was copied from, itself or -1; null: the body is never split
    const double* copied_at;   // (nodes,) since when it is a copy [s]
    int32_t* root;             // (nodes,) node of the body that the factor's matrix had in the place of each
    int32_t copies;            // nodes that it did not have
    int32_t groups;            // nodes with inverse blocks in `envelope`: copies and their roots, where T is left out
    int32_t *node, *place;     // (nodes,) T, in its order; place of each node in it, -1: not there
    int32_t* first;            // (3 nodes,) first column of each row
    int64_t* row;              // (3 nodes,) where the entry of column 0 of each row would be in `envelope`
    double* envelope;          // (capacity,) lower triangle of the Cholesky factor, row after row
    double *t, *room;          // (3 nodes,) on T; of the body
};

constexpr double ENOUGH_FOR_CUTS = 30;  // products with A that the factorization of S may cost

// The Schwarz method around one factor; allocates nothing.
struct CutSolve {
    CutNodes& c;
    const BlockCsr& A;

    // Finds T and factorizes A on it. step: of the factor's matrix
    void prepare(int64_t step) {
        const double since = c.start_time + (step + 0.5) * c.dt;
        find_copies(since);
        for (int rings = 1; rings >= 0; --rings) {  // with the neighbours, unless that is too much
            mark(since);
            if (!c.wanted) return;
            if (rings) widen();
            const double blocks = A.row_start[A.last] - A.row_start[A.first];
            sort();
            if (!assemble(ENOUGH_FOR_CUTS * 9 * blocks)) continue;
            if (factorize()) c.count = c.wanted;
            break;
        }
        if (c.copies && !c.count) invert_groups();
    }

    // Makes S on the nodes marked -2 in `place`. False if it takes more than `most` multiplications or is not positive definite.
    bool make(double most) {
        c.count = c.gone = c.copies = c.groups = 0;
        sort();
        if (assemble(most) && factorize()) c.count = c.wanted;
        return c.count > 0;
    }

    bool works() const { return c.count > 0 || c.gone > 0 || c.copies > 0; }

    // z = S r + (I - S A) P^-1 (I - A S) r. apply(from, z): z = P^-1 from
    template <class F> void around(const double* r, double* z, F apply) {
        if (!c.count) {
            if (c.copies) {
                std::copy(r, r + 3 * c.nodes, c.room);
                apply_whole(c.room, z, apply);
                add_groups(r, z);
            } else {
                apply(r, z);
            }
            set_apart(z);
            return;
        }
        std::copy(r, r + 3 * c.nodes, c.room);
        gather(r, c.t);
        solve(c.t);
        for (int k = 0; k < c.count; ++k) {  // (I - A S) r, by the columns of T
            const double* t = c.t + 3 * k;
            each_block(c.node[k], [&](int j, const double* a) {
                for (int m = 0; m < 3; ++m) c.room[3 * j + m] -= a[m] * t[0] + a[3 + m] * t[1] + a[6 + m] * t[2];
            });
        }
        apply_whole(c.room, z, apply);
        set_apart(z);
        double* s = c.room;
        for (int k = 0; k < c.count; ++k) {  // A z on T
            s[3 * k] = s[3 * k + 1] = s[3 * k + 2] = 0;
            each_block(c.node[k], [&](int j, const double* a) {
                for (int m = 0; m < 3; ++m) s[3 * k + m] += a[3 * m] * z[3 * j] + a[3 * m + 1] * z[3 * j + 1] + a[3 * m + 2] * z[3 * j + 2];
            });
        }
        solve(s);
        for (int k = 0; k < c.count; ++k)
            for (int m = 0; m < 3; ++m) z[3 * c.node[k] + m] += c.t[3 * k + m] - s[3 * k + m];
    }

private:
    // f(node of the body, block) of the blocks in a node's row of A.
    template <class F> void each_block(int i, F f) const {
        for (int64_t k = A.row_start[A.first + i]; k < A.row_start[A.first + i + 1]; ++k) f(A.columns[k] - A.first, A.values + 9 * k);
    }

    // z = M P^-1 M^T r, M the map by which copies that the factor does not know of move as the nodes that it has in their place.
    // Changes r.
    template <class F> void apply_whole(double* r, double* z, F apply) {
        for (int i = 0; c.copies && i < c.nodes; ++i)
            for (int m = 0; c.root[i] != i && m < 3; ++m) r[3 * c.root[i] + m] += r[3 * i + m], r[3 * i + m] = 0;
        apply(r, z);
        for (int i = 0; c.copies && i < c.nodes; ++i)
            for (int m = 0; c.root[i] != i && m < 3; ++m) z[3 * i + m] = z[3 * c.root[i] + m];
    }

    // Finds the nodes that the factor's matrix had in the place of copies made after a time.
    void find_copies(double since) {
        c.copies = c.groups = 0;
        for (int i = 0; c.origin && i < c.nodes; ++i) {
            int from = i;
            while (c.origin[from] >= 0 && c.origin[from] - A.first != from && c.copied_at[from] > since) from = c.origin[from] - A.first;
            c.root[i] = from;
            c.copies += from != i;
        }
    }

    // Inverse blocks of copies and their roots: where T is left out these alone tell them apart.
    void invert_groups() {
        for (int i = 0; i < c.nodes; ++i) c.place[i] = -1;
        for (int i = 0; i < c.nodes; ++i)
            if (c.root[i] != i) c.place[i] = c.place[c.root[i]] = -2;
        for (int i = 0; i < c.nodes && 9 * (int64_t)(c.groups + 1) <= c.capacity; ++i) {
            if (c.place[i] != -2) continue;
            double* own = c.envelope + 9 * (int64_t)c.groups;
            each_block(i, [&](int j, const double* a) { if (j == i) invert3(a, true, own); });
            c.node[c.groups++] = i;
        }
    }

    void add_groups(const double* r, double* z) const {
        for (int k = 0; k < c.groups; ++k) {
            double y[3];
            multiply3(c.envelope + 9 * (int64_t)k, r + 3 * c.node[k], y);
            for (int m = 0; m < 3; ++m) z[3 * c.node[k] + m] += y[m];
        }
    }

    void set_apart(double* z) const {
        for (int i = 0; c.gone && i < c.nodes; ++i)
            if (c.at_rest[i] != 0) z[3 * i] = z[3 * i + 1] = z[3 * i + 2] = 0;
    }

    void gather(const double* from, double* t) const {
        for (int k = 0; k < c.count; ++k)
            for (int m = 0; m < 3; ++m) t[3 * k + m] = from[3 * c.node[k] + m];
    }

    // Marks the nodes that lost or got back elements after a time.
    void mark(double since) {
        c.count = c.wanted = c.gone = 0;
        for (int i = 0; i < c.nodes; ++i) {
            c.place[i] = -1;
            if (c.at_rest[i] != 0) ++c.gone;
            else if (c.changed_at[i] > since && c.free[i] != 0) c.place[i] = -2, ++c.wanted;
        }
    }

    // Adds the neighbours of the marked nodes.
    void widen() {
        for (int i = 0; i < c.nodes; ++i)
            if (c.place[i] == -2)
                each_block(i, [&](int j, const double*) { if (c.place[j] == -1 && c.at_rest[j] == 0 && c.free[j] != 0) c.place[j] = -3; });
        for (int i = 0; i < c.nodes; ++i)
            if (c.place[i] == -3) c.place[i] = -2, ++c.wanted;
    }

    // Numbers T part by part, neighbours after neighbours, and turns the order round.
    void sort() {
        int found = 0;
        for (int i = 0; i < c.nodes; ++i) {
            if (c.place[i] != -2) continue;
            c.node[found] = i;
            c.place[i] = found++;
            for (int k = c.place[i]; k < found; ++k)
                each_block(c.node[k], [&](int j, const double*) {
                    if (c.place[j] == -2) c.node[found] = j, c.place[j] = found++;
                });
        }
        std::reverse(c.node, c.node + found);
        for (int k = 0; k < found; ++k) c.place[c.node[k]] = k;
    }

    // Copies A on T into the envelope; false if it is too large, or its factorization takes more than `most` multiplications.
    bool assemble(double most) {
        int64_t at = 0;
        double work = 0;
        for (int k = 0; k < c.wanted; ++k) {
            int least = k;
            each_block(c.node[k], [&](int j, const double*) { if (c.place[j] >= 0) least = std::min(least, c.place[j]); });
            for (int m = 0; m < 3; ++m) {
                c.first[3 * k + m] = 3 * least;
                c.row[3 * k + m] = at - 3 * least;
                at += 3 * (k - least) + m + 1;
                work += (double)(3 * (k - least) + m + 1) * (3 * (k - least) + m + 1);
            }
        }
        if (at > c.capacity || work > most) return false;
        std::fill(c.envelope, c.envelope + at, 0);
        for (int k = 0; k < c.wanted; ++k)
            each_block(c.node[k], [&](int j, const double* a) {
                const int p = c.place[j];
                if (p < 0 || p > k) return;
                for (int m = 0; m < 3; ++m)
                    for (int l = 0; l < 3 && 3 * p + l <= 3 * k + m; ++l) c.envelope[c.row[3 * k + m] + 3 * p + l] = a[3 * m + l];
            });
        return true;
    }

    static double product(const double* a, const double* b, int n) {
        double s = 0;
#pragma omp simd reduction(+ : s)
        for (int i = 0; i < n; ++i) s += a[i] * b[i];
        return s;
    }

    // In place; false if A is not positive definite there.
    bool factorize() {
        for (int i = 0; i < 3 * c.wanted; ++i) {
            double* own = c.envelope + c.row[i];
            for (int j = c.first[i]; j <= i; ++j) {
                const double* other = c.envelope + c.row[j];
                const int from = std::max(c.first[i], c.first[j]);
                const double s = own[j] - product(own + from, other + from, j - from);
                if (j < i) own[j] = s / other[j];
                else if (!(s > 0)) return false;
                else own[i] = std::sqrt(s);
            }
        }
        return true;
    }

    void solve(double* t) const {
        const int n = 3 * c.count;
        for (int i = 0; i < n; ++i) {
            const double* own = c.envelope + c.row[i];
            t[i] = (t[i] - product(own + c.first[i], t + c.first[i], i - c.first[i])) / own[i];
        }
        for (int i = n; i-- > 0;) {
            const double *own = c.envelope + c.row[i], x = t[i] /= own[i];
#pragma omp simd
            for (int j = c.first[i]; j < i; ++j) t[j] -= own[j] * x;
        }
    }
};
