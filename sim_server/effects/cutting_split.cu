// SPDX-License-Identifier: MIT
// Nodes that are copied where a body was split along faces of its elements (cutting.py).
#include "kernel.h"

struct Spawn {
    int n;                     // nodes
    const int* origin;         // (n,) node that each is a copy of, itself if it is none; -1: a spare node that is left
    const int* origin_before;  // (n,) in the last step
    real* x;                   // (n, 3) in, out [m]
    real* v;                   // (n, 3) in, out [m/s]
    real* predictor;           // (n, 3) in, out [m/s]
    real* damping_velocity;    // (n, 3) in, out [m/s]
    real* dv;                  // (n, 3) in, out: solution of the last step [m/s]
    real* first;               // (n, 3) in, out, as the next two: what else the scheme carries on, or v
    real* second;
    real* third;
    real* free;                // (n,) in, out: 0 at nodes that do not move
    real* at_rest;             // (n,) in, out: 1 at nodes without elements
};

// Begins copies where the node was that they were copied from. Reads nodes that were there before, writes others.
KERNEL(spawn, Spawn) {
    if (p.origin[i] < 0 || p.origin_before[i] >= 0) return;
    int from = p.origin[i];
    while (p.origin_before[from] < 0) from = p.origin[from];
    for (int k = 0; k < 3; ++k) {
        p.x[3 * i + k] = p.x[3 * from + k];
        p.v[3 * i + k] = p.v[3 * from + k];
        p.predictor[3 * i + k] = p.predictor[3 * from + k];
        p.damping_velocity[3 * i + k] = p.damping_velocity[3 * from + k];
        p.dv[3 * i + k] = p.dv[3 * from + k];
        p.first[3 * i + k] = p.first[3 * from + k];
        p.second[3 * i + k] = p.second[3 * from + k];
        p.third[3 * i + k] = p.third[3 * from + k];
    }
    p.free[i] = p.free[from];
    p.at_rest[i] = p.at_rest[from];
}

struct Note {
    int n;                // nodes
    const int* origin;    // (n,) as above
    const double* clock;  // (1,) [s]
    int* origin_before;   // (n,) in, out: `origin` in the last step
    double* copied_at;    // (n,) in, out: when the node was copied from another [s], -1: never
};

// Takes note of the copies that a step begins with.
KERNEL(note, Note) {
    if (p.origin[i] == p.origin_before[i]) return;
    p.copied_at[i] = p.clock[0];
    p.origin_before[i] = p.origin[i];
}
