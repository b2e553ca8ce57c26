// SPDX-License-Identifier: MIT
// Patches of corotational strain cells (formulas: _cells.py): the mean dilatation, the gradients of what they add to the tangent
// (kernels/patch_blocks.cu), and their energies. All are gathers: no two items write to the same place.
#include "coalesced_io.cuh"

struct PatchMeans {
    int n;                       // patches
    const int* start;            // (n + 1,) into cells
    const int* cells;            // (start[n],)
    const local* dilatation;     // (cells, 2) V tr(S - I), V tr T
    const local* inverse_volume; // (n,) 1 / V_p [1/m3]
    local* mean_dilatation;      // (n, 2) out: theta_p [-], its rate [1/s]
};

INLINE void means_add(const PatchMeans& p, int, int k, local* sum) {
    const local* d = p.dilatation + 2 * p.cells[k];
    sum[0] += d[0];
    sum[1] += d[1];
}

INLINE void means_put(const PatchMeans& p, int i, const local* sum) {
    p.mean_dilatation[2 * i] = p.inverse_volume[i] * sum[0];
    p.mean_dilatation[2 * i + 1] = p.inverse_volume[i] * sum[1];
}

SUM_KERNEL(means, PatchMeans, 2)

struct PatchGradients {
    int n;                          // corners of patches
    const int* start;               // (n + 1,) into slots
    const int* slots;               // (start[n],) of the cells of the patch at the node
    const int* cells;               // (start[n],) the cells
    const local* scaled_gradients;  // (slots, 4) sqrt(h (c + beta) mu V) R G_a of the cells
    const local* share;             // (cells,) sqrt(kappa V / (mu V_p)) [-]
    local* patch_gradients;         // (n, 4) out: sqrt(h (c + beta) kappa V_p) g_p,a, and 1
};

INLINE void gradients_add(const PatchGradients& p, int, int k, local* sum) {
    const local share = p.share[p.cells[k]];
    local g[4];
    get_row(p.scaled_gradients, p.slots[k], g);
    for (int m = 0; m < 3; ++m) sum[m] += share * g[m];
}

INLINE void gradients_put(const PatchGradients& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) p.patch_gradients[4 * i + m] = sum[m];
    p.patch_gradients[4 * i + 3] = 1;
}

SUM_KERNEL(gradients, PatchGradients, 3)

struct PatchEnergy {
    int n;                    // patches
    const int* start;         // (n + 1,) into cells
    const int* cells;         // (start[n],)
    const local* dilatation;  // (cells,) V tr(S - I) [m3], of corotational_cells.cu: energy
    const local* stiffness;   // (n,) kappa / V_p [Pa/m3]
    local* energy;            // (n,) out: kappa V_p theta_p^2 / 2 [J]
};

INLINE void energy_add(const PatchEnergy& p, int, int k, local* sum) { sum[0] += p.dilatation[p.cells[k]]; }

INLINE void energy_put(const PatchEnergy& p, int i, const local* sum) {
    p.energy[i] = (local)0.5 * p.stiffness[i] * sum[0] * sum[0];
}

SUM_KERNEL(energy, PatchEnergy, 1)
