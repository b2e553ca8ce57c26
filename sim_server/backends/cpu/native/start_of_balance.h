// SPDX-License-Identifier: MIT
// Begins the energy balance of a body in the state that its nodes have (kernels/energy_balance.cuh).
#pragma once
#include <cmath>

#include "energy_balance.cuh"

// x, v: of all nodes [m], [m/s]; the body has those from `first` up to `last`. mass [kg], gravity [m/s2], dt [s].
template <class T>
static void begin_balance(Balance& balance, int64_t first, int64_t last, const double* mass, const T* x, const T* v, const double* gravity,
                          double dt, bool inertia) {
    Sums s = no_sums();
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY}, size = 0;
    for (int64_t i = first; i < last; ++i) {
        const double at[3] = {x[3 * i], x[3 * i + 1], x[3 * i + 2]}, speed[3] = {v[3 * i], v[3 * i + 1], v[3 * i + 2]};
        const double step[3] = {dt * speed[0], dt * speed[1], dt * speed[2]};
        add_node(s, mass[i], at, speed, step, gravity);
        for (int c = 0; c < 3; ++c) {
            low[c] = std::fmin(low[c], at[c]);
            high[c] = std::fmax(high[c], at[c]);
        }
    }
    for (int c = 0; c < 3; ++c) size += square(high[c] - low[c]);
    start_balance(balance, s, std::sqrt(size), dt, inertia);
}
