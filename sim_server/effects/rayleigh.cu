// SPDX-License-Identifier: MIT
// Damping of the mass; world.stiffness_coefficient includes that of the stiffness.
#define WIDE
#include "mat3.cuh"

struct Drag {
    int n;               // nodes
    const real* mass;    // (n,) [kg]
    const real* alpha;   // (n,) [1/s]
    const real* v;       // (n, 3) [m/s]
    real h;              // world.force_coefficient [s]
    own<real> diagonal;  // (n, 1) in, out: += h alpha m [kg]
    own<real> b;         // (n, 3) in, out: -= h alpha m v [N s]
};

KERNEL(drag, Drag) {
    number c = p.h * at(p.alpha, i) * at(p.mass, i);
    row_put<1>(p.diagonal, i, 0, row_at<1>(p.diagonal, i, 0) + c);
    store3(p.b, i, load3(p.b, i) - c * load3(p.v, i));
}
