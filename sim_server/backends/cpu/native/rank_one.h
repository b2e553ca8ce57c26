// SPDX-License-Identifier: MIT
// Parts of A of rank one beside its blocks: scale u u^T over the nodes of a surface (backends/rank_one.py). Factors do not know of
// them; conjugate gradients then take about one more iteration for each.
#pragma once
#include <cstdint>

struct RankOne {
    const int32_t* first;    // (bodies + 1,) the first part of each body
    const int32_t* start;    // (parts + 1,) into node and slope
    const int32_t* node;     // of the scene
    const double* slope;     // (nodes of parts, 3) u, world frame
    const double* scale;     // (parts, 4) at 2: factor [kg over the square of u]
    const double* free;      // (nodes of the scene,) 0 at fixed nodes, where u counts as 0
    const double* rotation;  // (nodes, 3, 3) of the scene: world from material frame
};

// y += scale u (u . x) in the material frame, of the parts of a body whose first node is `at`; returns what x . y grows by.
static double add_product(const RankOne& terms, int body, int at, const double* x, double* y) {
    double sum = 0;
    for (int part = terms.first[body]; part < terms.first[body + 1]; ++part) {
        const double scale = terms.scale[4 * part + 2];
        if (!(scale > 0)) continue;
        double along = 0;
        auto each = [&](auto visit) {
            for (int k = terms.start[part]; k < terms.start[part + 1]; ++k) {
                if (terms.free[terms.node[k]] == 0) continue;
                const double *R = terms.rotation + 9 * (int64_t)terms.node[k], *u = terms.slope + 3 * (int64_t)k;
                const int64_t i = 3 * (int64_t)(terms.node[k] - at);
                for (int c = 0; c < 3; ++c) visit(i + c, R[c] * u[0] + R[3 + c] * u[1] + R[6 + c] * u[2]);
            }
        };
        each([&](int64_t i, double u) { along += u * x[i]; });
        const double pull = scale * along;
        each([&](int64_t i, double u) { y[i] += pull * u; });
        sum += pull * along;
    }
    return sum;
}
