// SPDX-License-Identifier: MIT
// What the host is told of the energy of a body (energy_balance.cu, elastic_energy.cu).
#pragma once
#include "energy_balance.cuh"

struct EnergyRecord {  // beside Result
    double kinetic, elastic, gravity, work, budget, stride;
    int phase, found;
};

#define FULL_WARP 0xffffffffu  // all threads of a warp
