// SPDX-License-Identifier: MIT
// Energy record of a body, written to host memory (energy_balance.cu, elastic_energy.cu).
#pragma once
#include "energy_balance.cuh"

struct EnergyRecord {  // one per PcgResult
    double kinetic, elastic, gravity, work, budget, stride;
    int phase, found;
};

#define FULL_WARP 0xffffffffu  // all threads of a warp
