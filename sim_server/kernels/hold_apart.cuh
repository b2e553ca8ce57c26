// SPDX-License-Identifier: MIT
// Bodies that a solution takes through each other, held apart: both sides move along the normal where they touch, by their masses, which
// keeps their momentum; shared by both devices. In each round all places are looked for first, and then held apart one after another.
#pragma once
#include "pair_detection.cuh"

constexpr int PAIR_HOLDS = 40;  // rounds
constexpr int MOST_HELD = 2;    // places of a vertex, or of an edge, in a round

struct HeldPlace {
    int body, other;            // body: of weights above 0; other: -1: the place is none
    int node[CORNERS];
    double weight[CORNERS], normal[3];
    double gap;                 // along the normal, of sum_a weight_a x_a, that is to be left [m]
};

HOST_DEVICE HeldPlace held_vertex(const SurfaceTables& c, int node, int body, const Meeting& t, double thickness) {
    const int* corner = c.triangle + 3 * t.triangle;
    const double *w = t.touch.weight, *n = t.touch.normal;
    return {body, t.other, {node, corner[0], corner[1], corner[2]}, {1, -w[0], -w[1], -w[2]}, {n[0], n[1], n[2]}, 0.1 * thickness};
}

HOST_DEVICE HeldPlace held_edges(const int* edge, const int* facing, int body, int other, double s, double t, const double* n, double thickness) {
    return {body, other, {edge[0], edge[1], facing[0], facing[1]}, {1 - s, s, t - 1, -t}, {n[0], n[1], n[2]}, 0.1 * thickness};
}

// Moves the nodes of a place by their weights over their masses until the gap is there. False if there is nothing to move.
// m: the motion by y. moves(a): whether corner a may move
template <class Real, class Local, class Moves>
HOST_DEVICE bool hold_apart(const SurfaceMotion<Real, Local>& m, const Real* mass, const HeldPlace& p, Real* y, Moves moves) {
    double lacks = p.gap, share = 0;
    for (int a = 0; a < CORNERS; ++a) {
        double x[3], s[3];
        place_of(m, p.node[a], x);
        displacement_of(m, p.node[a], s);
        for (int k = 0; k < 3; ++k) lacks -= p.weight[a] * p.normal[k] * (x[k] + s[k]);
        if (moves(a)) share += p.weight[a] * p.weight[a] / mass[p.node[a]];
    }
    if (!(lacks > 0) || !(share > 0)) return false;
    for (int a = 0; a < CORNERS; ++a) {
        if (!moves(a) || p.weight[a] == 0) continue;
        const Local* R = m.rotation + 9 * (long long)p.node[a];
        Real* own = y + 3 * (long long)p.node[a];
        double dv[3];
        for (int k = 0; k < 3; ++k) dv[k] = lacks / share * p.weight[a] / mass[p.node[a]] * p.normal[k] / m.dx_dv;
        for (int k = 0; k < 3; ++k) own[k] += (Real)((double)R[k] * dv[0] + (double)R[3 + k] * dv[1] + (double)R[6 + k] * dv[2]);
    }
    return true;
}
