// SPDX-License-Identifier: MIT
// Nodes that lose elements (cutting.py): when they did, and rest for those that have none left.
#include "kernel.h"

struct Settle {
    int n;                // nodes
    const real* left;     // (n,) part of the node's elements that is there
    const double* clock;  // (1,) [s]
    real* left_before;    // (n,) in, out: `left` in the last step
    double* changed_at;   // (n,) in, out: when the node last lost or got back an element [s]
    real* at_rest;        // (n,) in, out: 1 at nodes without elements
    const real* surface;  // (n,) 1 at nodes of the surface
    real* free;           // (n,) in, out: 0 at these
    real* touchable;      // (n,) out: 1 at nodes of the surface that move
    real* v;              // (n, 3) in, out [m/s]
    real* predictor;      // (n, 3) in, out [m/s]
};

KERNEL(settle, Settle) {
    if (p.left[i] != p.left_before[i]) p.changed_at[i] = p.clock[0];
    p.left_before[i] = p.left[i];
    const bool rests = p.left[i] == 0;
    if (rests && p.free[i] != 0) p.at_rest[i] = 1;
    if (p.at_rest[i] != 0) {
        p.at_rest[i] = rests;
        p.free[i] = rests ? 0 : 1;
        for (int k = 0; k < 3; ++k) p.v[3 * i + k] = p.predictor[3 * i + k] = 0;
    }
    p.touchable[i] = p.free[i] * p.surface[i];
}
