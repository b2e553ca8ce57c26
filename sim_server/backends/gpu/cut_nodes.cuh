// SPDX-License-Identifier: MIT
// Keeps a factor useful after elements were removed or a body was split (backends/cpu/native/cut_nodes.h), in the solver of a GPU
// (pcg.cu). Nodes without elements are set apart: r = 0 into P, z = 0 out of it. Of copies of nodes that the factor P does not know
//     z = M P^-1 M^T r + G r
// is made, M the map by which they move as the nodes that the factor's matrix has in their place, G the inverses of the own blocks
// of copies and of these nodes. Thread blocks tell each other r of copies, which those that have the nodes in their place add up, by
// words of their own. A direct solve around the cut, as on a CPU, would be done by one thread block and take longer than the iterations
// that it saves.
#pragma once
#include "pcg_structs.cuh"

// What BlockRows.place has beside the position of a node: of one without elements, of a copy, of a node with copies.
constexpr int APART = (int)0x80000000u, COPIED = 1 << 30, SHARED = 1 << 29, PLACE = SHARED - 1;

#ifdef SPLITS
// The node of the scene that the matrix of a factor had in the place of node i.
__device__ __forceinline__ int known_node(const PcgArguments& s, int i, long long factor_step) {
    while (s.origin[i] >= 0 && s.origin[i] != i && s.copied_step[i] > factor_step) i = s.origin[i];
    return i;
}

// Whether copies stand for node i that this matrix does not have.
__device__ __forceinline__ bool is_shared(const PcgArguments& s, int i, long long factor_step) {
    return s.origin[i] >= 0 && s.spread_step[i] > factor_step;
}

// First copy of the node of the mesh that node i comes from; `sibling` leads to the others.
__device__ __forceinline__ int first_copy(const PcgArguments& s, int i) {
    while (s.origin[i] != i) i = s.origin[i];
    return s.sibling[i];
}
#endif
