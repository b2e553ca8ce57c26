// SPDX-License-Identifier: MIT
#define WIDE
#include "mat3.cuh"

struct Gravity {
    int n;             // nodes
    const real* mass;  // (n,) [kg]
    const real* g;     // (3,) [m/s2]
    real h;            // world.force_coefficient [s]
    own<real> b;       // (n, 3) in, out: += h m g [N s]
};

KERNEL(gravity, Gravity) {
    store3(p.b, i, load3(p.b, i) + (p.h * at(p.mass, i)) * load3(p.g, 0 * i));
}
