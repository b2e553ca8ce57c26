// SPDX-License-Identifier: MIT
// Patches of tetrahedra of a law W = W_s(I1, I2, J) + U(J) that share the mean of J (formulas: _hyperelastic_patches.py): U' and U''
// of the mean, the gradients of the mean, and V_p U. LAW is the text of the law. All are gathers: no two items write to the same
// place.
#include "hyperelastic.cuh"
#include "invariants.cuh"
#include LAW

static_assert((HAS & W_JJ) != 0, "U is a function of J");

struct PatchPressures {
    int n;                               // patches
    int projection;                      // of the tangent
    const int* start;                    // (n + 1,) into cells
    const int* cells;                    // (start[n],)
    const local* dilatation;             // (cells, 2) V (J - 1), V dJ/dt
    const local* volume;                 // (n,) V_p [m3]
    const local* bulk;                   // (n,) constant of U [Pa]
    const local* floor;                  // (n,) J below which U goes on as a parabola, 0: J <= 0 is refused
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    local* pressure;                     // (n, 2) out: U' [Pa], U'' times the rate of the mean of J [Pa/s]
    local* weight;                       // (n,) out: factor V_p U'' [J s2]
};

INLINE void pressures_add(const PatchPressures& p, int, int k, local* sum) {
    const local* d = p.dilatation + 2 * p.cells[k];
    sum[0] += d[0];
    sum[1] += d[1];
}

// U'' is not below 0 where the tangent is projected. A patch whose mean U does not define has nothing: it has elements that are
// refused.
INLINE void pressures_put(const PatchPressures& p, int i, const local* sum) {
    const local volume = p.volume[i], floor = p.floor[i], J = 1 + sum[0] / volume;
    const Jet<local> U = volumetric(p.bulk[i], J, floor);
    const bool undefined = REFUSES && J <= 0 && floor == 0;
    const local second = undefined || (p.projection != NONE && U.dd < 0) ? 0 : U.dd;
    p.pressure[2 * i] = undefined ? 0 : U.d;
    p.pressure[2 * i + 1] = second * sum[1] / volume;
    p.weight[i] = p.stiffness_coefficient[i] * volume * second;
}

SUM_KERNEL(pressures, PatchPressures, 2)

struct PatchVolumeGradients {
    int n;                   // corners of patches
    const int* start;        // (n + 1,) into slots
    const int* slots;        // (start[n],) of the cells of the patch at the node
    const int* patch;        // (n,)
    const local* areas;      // (slots, 3) V dJ/dx of the cells [m2]
    const local* volume;     // (patches,) V_p [m3]
    const local* weight;     // (patches,) factor V_p U'' [J s2]
    local* patch_gradients;  // (n, 4) out: gradient of the mean of J [1/m], and the weight
};

INLINE void gradients_add(const PatchVolumeGradients& p, int, int k, local* sum) {
    const local* area = p.areas + 3 * (long long)p.slots[k];
    for (int m = 0; m < 3; ++m) sum[m] += area[m];
}

INLINE void gradients_put(const PatchVolumeGradients& p, int i, const local* sum) {
    const local inverse = 1 / p.volume[p.patch[i]];
    for (int m = 0; m < 3; ++m) p.patch_gradients[4 * i + m] = inverse * sum[m];
    p.patch_gradients[4 * i + 3] = p.weight[p.patch[i]];
}

SUM_KERNEL(gradients, PatchVolumeGradients, 3)

struct PatchVolumeEnergy {
    int n;                    // patches
    const int* start;         // (n + 1,) into cells
    const int* cells;         // (start[n],)
    const local* dilatation;  // (cells,) V (J - 1) [m3], of hyperelastic_cells.cu: energy
    const local* volume;      // (n,) V_p [m3]
    const local* bulk;        // (n,) constant of U [Pa]
    const local* floor;       // (n,)
    local* energy;            // (n,) out: V_p U [J]
};

INLINE void energy_add(const PatchVolumeEnergy& p, int, int k, local* sum) { sum[0] += p.dilatation[p.cells[k]]; }

INLINE void energy_put(const PatchVolumeEnergy& p, int i, const local* sum) {
    const local volume = p.volume[i], one = 1;
    p.energy[i] = volume * volumetric(p.bulk[i], one + sum[0] / volume, p.floor[i]).f;
}

SUM_KERNEL(energy, PatchVolumeEnergy, 1)
