// SPDX-License-Identifier: MIT
// Local refresh of a factor on a GPU: an old factor P is far from A where the body has changed most since its matrix. With T these nodes
// and S the inverse of A on T,
//     z = (I - S A) P^-1 r + S r
// after a start with r = 0 on T: the method A-DEF2, in exact arithmetic the symmetric multiplicative Schwarz method that a CPU has
// (backends/cpu/native/local_refresh.h, whose numbers these are), with one application of S and one product with rows of A instead of two.
// (Tang, Nabben, Vuik and Erlangga, J. Sci. Comput. 39, 2009.)
//
// Each step notes the nodes' own blocks of A; a factor knows those of its matrix by its step. Decisions are by iterations, residuals and
// sizes, no clock, so that a run repeats.
#pragma once
#include "pcg_structs.cuh"

constexpr int REFRESH_AFTER = 6;         // iterations of a solve
constexpr int REFRESH_WORTH = 10;        // iterations that it would still need without
constexpr double CHANGED = 0.05;         // of a node's own block: smaller changes are ignored
constexpr double CHANGED_STEP = 1.6;     // by which that grows until T has few enough nodes
constexpr int CHANGED_LEVELS = 8;        // times that it may grow
constexpr int MOST_REFRESHED = 40;       // nodes of T
constexpr int REFRESHED_FREEDOMS = 120;  // 3 MOST_REFRESHED
constexpr int REFRESH_ROOM = 15120;      // numbers of A on T, and of room to invert it

struct RefreshedBody {
    long long slow;           // step of the matrix of the factor with which a solve was slow last, -1: none was
    int used, unused;         // nodes of T in the last solve, 0: the factor was enough
};

struct Refresh {              // arguments
    int kept, nodes;          // steps whose blocks are kept; nodes of the scene
    const int* own_block;     // (nodes,) each node's own block, among the values of A
    float* blocks_then;       // (kept, nodes, 6) own blocks, upper triangles [kg]
    long long* noted;         // (kept, bodies) step that they are of
    float* score;             // (nodes,) change relative to the own block
    double* room;             // (bodies, REFRESH_ROOM)
    float* inner;             // (bodies, REFRESHED_FREEDOMS, REFRESHED_FREEDOMS) S
    FlagWord<float>* t;       // (bodies, REFRESHED_FREEDOMS) what S is applied to
    RefreshedBody* bodies;    // (bodies,)
};
