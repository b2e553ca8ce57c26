// SPDX-License-Identifier: MIT
// Patches of corotational strain cells (formulas: _cells.py): the mean dilatation, the gradients of what they add to the tangent,
// one block per pair of their nodes, and their energies. All are gathers: no two items write to the same place.
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
    local* patch_gradients;         // (n, 4) out: sqrt(h (c + beta) kappa V_p) g_p,a, and 0
};

INLINE void gradients_add(const PatchGradients& p, int, int k, local* sum) {
    const local share = p.share[p.cells[k]];
    local g[4];
    get_row(p.scaled_gradients, p.slots[k], g);
    for (int m = 0; m < 3; ++m) sum[m] += share * g[m];
}

INLINE void gradients_put(const PatchGradients& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) p.patch_gradients[4 * i + m] = sum[m];
    p.patch_gradients[4 * i + 3] = 0;
}

SUM_KERNEL(gradients, PatchGradients, 3)

struct PatchNodes {
    int n;                         // nodes
    const int* start;              // (n + 1,) into corners
    const int* corners;            // (start[n],) corners of patches at the node
    const local* patch_gradients;  // (corners, 4)
    own<local> block;              // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
};

INLINE void own_blocks_add(const PatchNodes& p, int, int k, local* sum) {
    local g[4];
    get_row(p.patch_gradients, p.corners[k], g);
    sum[0] += g[0] * g[0]; sum[1] += g[0] * g[1]; sum[2] += g[0] * g[2];
    sum[3] += g[1] * g[1]; sum[4] += g[1] * g[2]; sum[5] += g[2] * g[2];
}

INLINE void own_blocks_put(const PatchNodes& p, int i, const local* sum) {
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[m]);
}

SUM_KERNEL(own_blocks, PatchNodes, 6)

struct PatchBlocks {
    int n;                         // blocks above the diagonal
    const int* start;              // (n + 1,) into pairs
    const int* pairs;              // (start[n], 2) corners of patches at the block's row and column
    const local* patch_gradients;  // (corners, 4)
    own<local> sums;               // (n, 9) in, out, world frame, row major [kg]
};

INLINE void blocks_add(const PatchBlocks& p, int, int k, local* s) {
    local a[4], b[4];
    get_row(p.patch_gradients, p.pairs[2 * k], a);
    get_row(p.patch_gradients, p.pairs[2 * k + 1], b);
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) s[3 * r + c] += a[r] * b[c];
}

INLINE void blocks_put(const PatchBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, row_at<9>(p.sums, i, m) + sum[m]);
}

SUM_KERNEL(blocks, PatchBlocks, 9)

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
