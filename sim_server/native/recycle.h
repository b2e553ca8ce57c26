// SPDX-License-Identifier: MIT
// Directions of the last solves, kept to correct a preconditioner that has grown old: pairs (s, y = A s) of the conjugate
// gradients, which know what P lacks where the last solves had to go. For pairs scaled to s'y = 1, one after another,
//     M <- (I - s y') M (I - y s') + s s'     beginning with M = P^-1:
// the update of the BFGS method, as in Morales and Nocedal, Automatic preconditioning by limited memory quasi-Newton
// updating, SIAM J. Optim. 10, 2000. M is symmetric positive definite whatever the pairs are, and maps each y of one solve to
// its s, so a system solved once is solved again in one iteration. No product with A is made for it.
// Pairs are those of the material frame, as a factor is; the first ones of each solve, which get furthest.
#pragma once
#include <cmath>
#include <cstdint>

#include "block_csr.h"

struct Recycled {
    int32_t capacity;  // pairs used; as many again may be stored during a solve; 0: off
    int32_t unused;
    int64_t stored;    // since they were last forgotten
    float* pairs;      // (2 capacity, 2, n): s, y
    double* weight;    // (capacity,) scratch
};

static double dot(int n, const float* a, const double* b) {
    double sum[8] = {0};
    int i = 0;
    for (; i + 8 <= n; i += 8)
        for (int k = 0; k < 8; ++k) sum[k] += a[i + k] * b[i + k];
    for (; i < n; ++i) sum[0] += a[i] * b[i];
    return ((sum[0] + sum[4]) + (sum[1] + sum[5])) + ((sum[2] + sum[6]) + (sum[3] + sum[7]));
}

static void add(int n, double factor, const float* a, double* b) {
    for (int i = 0; i < n; ++i) b[i] += factor * a[i];
}

// The pairs that a solve uses, fixed at its beginning, and room for those that it makes.
struct Recycling {
    Recycled* kept;    // or null
    int n;
    int64_t first, last;
    int made = 0;

    Recycling(Recycled* kept, int n) : kept(kept && kept->capacity > 0 ? kept : nullptr), n(n) {
        last = this->kept ? kept->stored : 0;
        first = this->kept && last > kept->capacity ? last - kept->capacity : 0;
    }
    bool any() const { return last > first; }
    float* pair(int64_t k) const { return kept->pairs + 2 * (int64_t)n * (k % (2 * kept->capacity)); }

    // Before P^-1: r -> (I - y s') ... r, newest first.
    void before(double* r) const {
        for (int64_t k = last - 1; k >= first; --k) {
            double weight = kept->weight[k - first] = dot(n, pair(k), r);
            add(n, -weight, pair(k) + n, r);
        }
    }
    // After it: z -> (I - s y') z + s s' r, oldest first.
    void after(double* z) const {
        for (int64_t k = first; k < last; ++k) add(n, kept->weight[k - first] - dot(n, pair(k) + n, z), pair(k), z);
    }
    // s = p, y = q = A p with p'q = pq > 0.
    void keep(const double* p, const double* q, double pq) {
        if (!kept || made == kept->capacity || !(pq > 1e-200 && pq < 1e200)) return;
        float *s = pair(last + made), *y = s + n;
        double scale = 1 / std::sqrt(pq);
        for (int i = 0; i < n; ++i) s[i] = (float)(scale * p[i]);
        for (int i = 0; i < n; ++i) y[i] = (float)(scale * q[i]);
        ++made;
    }
    void forget() { first = last = 0, made = 0; if (kept) kept->stored = 0; }
    void close() { if (kept) kept->stored = last + made; }
};
