// SPDX-License-Identifier: MIT
// Sums impulses and tangents of rods (rod.cu) at the nodes and in the blocks of A. Gathers: no two items write to the same place.
#include "coalesced_io.cuh"

struct RodNodes {
    int n;                       // nodes
    int corners;                 // of each element
    const int* start;            // (n + 1,) into slots
    const int* slots;            // (start[n],) corners e + a: corner a of element e is at the node
    const real* weights;         // (elements, corners)
    const local* nodal_impulse;  // (elements, 3) over W [N s]
    const local* tangent;        // (elements, 4) g, e
    own<real> b;                 // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;            // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
};

INLINE void nodes_add(const RodNodes& p, int, int k, local* sum) {
    const int slot = p.slots[k], element = slot / p.corners;
    const local weight = (local)p.weights[slot], square = weight * weight;
    const local* f = p.nodal_impulse + 3 * (long long)element;
    local g[4];
    get_row(p.tangent, element, g);
    for (int m = 0; m < 3; ++m) sum[m] += weight * f[m];
    sum[3] += square * (g[0] * g[0] + g[3]); sum[4] += square * g[0] * g[1]; sum[5] += square * g[0] * g[2];
    sum[6] += square * (g[1] * g[1] + g[3]); sum[7] += square * g[1] * g[2]; sum[8] += square * (g[2] * g[2] + g[3]);
}

INLINE void nodes_put(const RodNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
}

SUM_KERNEL(nodes, RodNodes, 9)

struct RodBlocks {
    int n;                 // blocks above the diagonal
    int corners;           // of each element
    int accumulate;        // 0: write, 1: add to what another effect wrote
    const int* start;      // (n + 1,) into pairs
    const int* pairs;      // (start[n],) corners^2 e + corners a + b: corners a and b of element e are at the block's row and column
    const real* weights;   // (elements, corners)
    const local* tangent;  // (elements, 4) g, e
    own<local> sums;       // (n, 9) out, world frame, row major [kg]
};

INLINE void blocks_add(const RodBlocks& p, int, int k, local* s) {
    const int slot = p.pairs[k] / p.corners, second = p.pairs[k] % p.corners, element = slot / p.corners;
    const local share = (local)p.weights[slot] * (local)p.weights[p.corners * element + second];
    local g[4];
    get_row(p.tangent, element, g);
    local xy = share * g[0] * g[1], xz = share * g[0] * g[2], yz = share * g[1] * g[2];
    s[0] += share * (g[0] * g[0] + g[3]); s[1] += xy; s[2] += xz;
    s[3] += xy; s[4] += share * (g[1] * g[1] + g[3]); s[5] += yz;
    s[6] += xz; s[7] += yz; s[8] += share * (g[2] * g[2] + g[3]);
}

INLINE void blocks_put(const RodBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, p.accumulate ? row_at<9>(p.sums, i, m) + sum[m] : sum[m]);
}

SUM_KERNEL(blocks, RodBlocks, 9)
