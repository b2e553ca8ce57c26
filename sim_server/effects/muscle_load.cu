// SPDX-License-Identifier: MIT
// Sums the forces of muscles at each node, whose work the energy balance counts. A gather: no two items write to the same place.
#include "kernel.h"

struct MuscleLoad {
    int n;                // nodes
    int elements;
    const int* start;     // (n + 1,) into slots
    const int* slots;     // (start[n],) 4 e + a: corner a of element e is at the node
    const local* forces;  // (4, elements, 3) [N]
    int accumulate;       // 0: write load, 1: add to what another effect wrote
    real* load;           // (n, 3) out, for the energy balance [N]
};

INLINE void load_add(const MuscleLoad& p, int, int k, local* sum) {
    int slot = p.slots[k];
    const local* f = p.forces + 3 * ((long long)p.elements * (slot & 3) + (slot >> 2));
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
}

INLINE void load_put(const MuscleLoad& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) p.load[3 * i + m] = p.accumulate ? p.load[3 * i + m] + sum[m] : sum[m];
}

SUM_KERNEL(load, MuscleLoad, 3)
