// SPDX-License-Identifier: MIT
// Nodes that lose elements (cutting.py): when they did, and rest for those that have none left.
#include "kernel.h"

struct Settle {
    int n;                // nodes
    const real* left;     // (n,) part of the node's elements that is there
    const double* clock;  // (1,) [s]
    real* known;          // (n,) in, out: `left` in the last step
    real* out;            // (n,) in, out: 1 at nodes that were put to rest
    real* lost;           // (n,) in, out: when the node last lost an element [s]
    real* free;           // (n,) in, out: 0 at nodes that rest
    real* v;              // (n, 3) in, out [m/s]
    real* predictor;      // (n, 3) in, out [m/s]
};

KERNEL(settle, Settle) {
    if (p.left[i] < p.known[i]) p.lost[i] = (real)p.clock[0];
    p.known[i] = p.left[i];
    const bool rests = p.left[i] == 0;
    if (rests && p.out[i] == 0 && p.free[i] != 0) p.out[i] = 1;
    if (p.out[i] == 0) return;
    p.out[i] = rests;
    p.free[i] = rests ? 0 : 1;
    for (int k = 0; k < 3; ++k) p.v[3 * i + k] = p.predictor[3 * i + k] = 0;
}
