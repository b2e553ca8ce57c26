// SPDX-License-Identifier: MIT
// What the first stage of a Rosenbrock-W step is assembled from (formulas and symbols: mechanics/rosenbrock.py).
#pragma once
#include "mat3.cuh"

// p: share and weight (n,) theta and w [-]; predictor, damping_velocity, inertial_increment, dv (n, 3) out [m/s].
template <class P, class I> INLINE void prepare_stage(const P& p, I i, vec3 v, vec3 inertial, vec3 start) {
    number share = at(p.share, i);
    store3(p.predictor, i, (1 - share) * start);
    store3(p.damping_velocity, i, (1 - share) * v);
    store3(p.inertial_increment, i, inertial + at(p.weight, i) * start);
    store3(p.dv, i, share * start);
}
