// SPDX-License-Identifier: MIT
// Flow of the fluid in pores, at nodes (formulas: poroelasticity.py).
#include "mat3.cuh"

struct PoreMeans {
    int n;                // nodes
    const int* start;     // (n + 1,) into elements
    const int* elements;  // (start[n],) those at the node
    const real* share;    // (start[n],) of their values in the mean of the node
    const real* open;     // (n,) 1, or 0 where it is drained
    const real* field;    // (1, elements)
    real* mean;           // (n,) out, 0 where it is drained
};

KERNEL(gather, PoreMeans) {
    real sum = 0;
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) sum += p.share[k] * p.field[p.elements[k]];
    p.mean[i] = p.open[i] * sum;
}

// A stage of a Runge-Kutta-Legendre method: mu y[j-1] + nu y[j-2] + step y'[j-1].
struct PoreStage {
    int n;               // nodes
    const int* start;    // (n + 1,) into columns
    const int* columns;  // (start[n],) nodes
    const real* flow;    // (start[n],) out of the node by the pressure of another [m3/(Pa s)]
    const real* rate;    // (n,) what the flow into the node raises its pressure by in a step; 0 where it is drained [Pa s/m3]
    real mu, nu, step;
    const real* last;    // (n,) y[j-1] [Pa]
    const real* before;  // (n,) y[j-2] [Pa]
    real* out;           // (n,) y[j], may be `before` [Pa]
};

KERNEL(stage, PoreStage) {
    real sum = 0;
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) sum += p.flow[k] * p.last[p.columns[k]];
    p.out[i] = p.mu * p.last[i] + p.nu * p.before[i] - p.step * p.rate[i] * sum;
}
