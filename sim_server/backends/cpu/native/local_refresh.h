// SPDX-License-Identifier: MIT
// An old factor is far from A where the body has changed most since its matrix: a few hundredths of the nodes at the joints of stiff and
// soft material carry the eigenvalues that cost iterations. There an exact solve on T, these nodes, is put around the factor, as after cuts
// (cut_nodes.h). A solve that has not come far in REFRESH_AFTER iterations goes over to it if it would otherwise need many more, and those
// that follow with the same factor begin with it. What A had on its diagonal is noted when a copy of it is taken for a worker, so that it
// is known once the factor comes.
//
// All decisions are by iterations, residuals and sizes, no clock, so that a run repeats.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "cut_nodes.h"

constexpr int REFRESH_AFTER = 6;         // iterations of a solve
constexpr double REFRESH_WORTH = 10;     // iterations that it would still need without
constexpr double REFRESH_WORK = 2;       // multiplications for S, for each number of L and A: about an iteration's time
constexpr double CHANGED = 0.05;         // of a node's own block: smaller changes are ignored
constexpr double CHANGED_STEP = 1.6;     // by which that grows until S costs little enough
constexpr int UPPER[6] = {0, 1, 2, 4, 5, 8};

struct KnownDiagonals {    // of a body, at the copies taken last
    int32_t kept;          // copies
    int32_t refreshed;     // nodes on which the last solve was exact, 0: the factor was enough
    int64_t notes;         // so far
    int64_t slow;          // step of the matrix of the factor with which a solve was slow last, -1: none was
    int64_t* step;         // (kept,) of the copies
    float* block;          // (kept, nodes, 6) upper triangles of the nodes' own blocks [kg]
    double* score;         // (nodes,) room
    CutNodes* room;        // T, on which S is exact
};

static const double* own_block(const BlockCsr& A, int i) {
    int k = A.row_start[A.first + i];
    while (A.columns[k] != A.first + i) ++k;
    return A.values + 9 * (int64_t)k;
}

static void note_diagonal(KnownDiagonals* known, const BlockCsr& A, int64_t step) {
    if (!known) return;
    const int64_t slot = known->notes++ % known->kept, nodes = A.last - A.first;
    known->step[slot] = step;
    for (int i = 0; i < nodes; ++i) {
        const double* a = own_block(A, i);
        for (int m = 0; m < 6; ++m) known->block[6 * (slot * nodes + i) + m] = (float)a[UPPER[m]];
    }
}

// Makes S for the nodes that changed most since the matrix of a factor. entries: numbers of L and A. False if that is not known, or S costs too
// much even for the few that changed most.
static bool refresh(KnownDiagonals* known, const BlockCsr& A, int64_t step, double entries) {
    if (!known) return false;
    const int64_t kept = std::min<int64_t>(known->notes, known->kept);
    const int64_t slot = std::find(known->step, known->step + kept, step) - known->step;
    if (slot == kept) return false;
    CutNodes& c = *known->room;
    double most = 0;
    for (int i = 0; i < c.nodes; ++i) {
        const float* then = known->block + 6 * (slot * c.nodes + i);
        const double* now = own_block(A, i);
        double change = 0, size = 0;
        for (int m = 0; m < 6; ++m) {
            change += std::fabs(now[UPPER[m]] - then[m]);
            size += std::fabs(now[UPPER[m]]);
        }
        known->score[i] = change / size;
        most = std::max(most, known->score[i]);
    }
    for (double least = CHANGED; least < most; least *= CHANGED_STEP) {
        for (int i = c.wanted = 0; i < c.nodes; ++i) {
            c.place[i] = known->score[i] > least ? -2 : -1;
            c.wanted += known->score[i] > least;
        }
        if (CutSolve{c, A}.make(REFRESH_WORK * entries)) return known->refreshed = c.count, true;
    }
    return false;
}
