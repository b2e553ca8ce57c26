// SPDX-License-Identifier: MIT
// Energies of a body after a step (energy_balance.cu, elastic_energy.cu), of which step_records.cu makes its record.
#pragma once
#include "energy_balance.cuh"

struct EnergyRecord {  // one per PcgResult
    double kinetic, elastic, gravity, work, budget, stride;
    int phase, found;
};

#define FULL_WARP 0xffffffffu  // all threads of a warp
