// SPDX-License-Identifier: MIT
// The damping of the mass; that of the stiffness is in the elements' h (h + beta).
#define WIDE
#include "mat3.cuh"

struct Drag {
    int n;              // nodes
    const real* mass;   // (n,) [kg]
    const real* alpha;  // (n,) [1/s]
    const real* v;      // (n, 3) [m/s]
    real h;             // [s]
    real* diagonal;     // (n,) in, out: += h alpha m [kg]
    real* b;            // (n, 3) in, out: -= h alpha m v [N s]
};

KERNEL(drag, Drag) {
    number c = p.h * at(p.alpha, i) * at(p.mass, i);
    put(p.diagonal, i, at(p.diagonal, i) + c);
    store3(p.b, i, load3(p.b, i) - c * load3(p.v, i));
}
