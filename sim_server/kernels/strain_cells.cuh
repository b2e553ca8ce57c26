// SPDX-License-Identifier: MIT
// Loops over the nodes of strain cells, which lie in slices of 32 cells (mechanics/clusters.py): neighbouring items read neighbouring
// entries. Items of two slices may share a vector; where one of them has no more slots it takes the last slot, of gradient 0.
#pragma once
#include "polar.cuh"
#include "coalesced_io.cuh"

constexpr int SLICE = 32;  // cells of a slice

struct slots {
    index first, width;
};

// Slot k of each item, `none` where it has no such.
INLINE index slot_of(const slots& s, int k, int none) { return s.width > k ? s.first + SLICE * k : index{} + none; }

INLINE local_vec3 slot_gradient(const local* gradients, int count, index slot) {
    return {at_items(gradients, slot), at_items(gradients + count, slot), at_items(gradients + 2 * (long long)count, slot)};
}

// Row `slot` of an array (slots, K). On a GPU a warp has a whole slice, so its rows are neighbours (coalesced_io.cuh).
template <int K> INLINE void put_slot(local* a, index slot, index i, int n, const local_number (&row)[K]) {
#ifdef __CUDACC_RTC__
    put_row(a, slot, n + (slot - i), row);
#else
    put_row(a, slot, n, row);
#endif
}

// F += u (x) g
template <class T> INLINE void add_outer(mat<T>& F, vec<T> u, vec<T> g) {
    F.m[0] += u.x * g.x; F.m[1] += u.x * g.y; F.m[2] += u.x * g.z;
    F.m[3] += u.y * g.x; F.m[4] += u.y * g.y; F.m[5] += u.y * g.z;
    F.m[6] += u.z * g.x; F.m[7] += u.z * g.y; F.m[8] += u.z * g.z;
}

// Gradients of two nodal fields over a cell: their differences from its first node in the fields' precision.
INLINE void cell_gradients(const slots& s, const int* nodes, const local* gradients, int count, const real* x, const real* v,
                           local_mat3& F, local_mat3& G) {
    const index first = at(nodes, s.first);
    const vec3 x0 = load3(x, first), v0 = load3(v, first);
    F = {}; G = {};
    for (int k = 1; any(s.width > k); ++k) {
        const index slot = slot_of(s, k, count - 1), node = s.width > k ? at(nodes, slot) : first;
        const local_vec3 g = slot_gradient(gradients, count, slot);
        add_outer(F, as<local_number>(load3(x, node) - x0), g);
        add_outer(G, as<local_number>(load3(v, node) - v0), g);
    }
}

template <class T>
INLINE mat<T> cell_gradient(const slots& s, const int* nodes, const local* gradients, int count, const real* x) {
    const index first = at(nodes, s.first);
    const vec3 x0 = load3(x, first);
    mat<T> F = {};
    for (int k = 1; any(s.width > k); ++k) {
        const index slot = slot_of(s, k, count - 1), node = s.width > k ? at(nodes, slot) : first;
        add_outer(F, as<T>(load3(x, node) - x0), as<T>(slot_gradient(gradients, count, slot)));
    }
    return F;
}

// Nodal impulses -P g of all slots of an item; n: items of the kernel.
INLINE void put_cell_impulses(const slots& s, index i, int n, const local* gradients, int count, const local_mat3& P,
                              local* nodal_impulse) {
    for (int k = 0; any(s.width > k); ++k) {
        const index slot = slot_of(s, k, count - 1);
        const local_vec3 f = -mul(P, slot_gradient(gradients, count, slot));
        const local_number row[3] = {f.x, f.y, f.z};
        put_slot(nodal_impulse, slot, i, n, row);
    }
}

// Scaled gradients w R g of all slots, and the ratio lambda / mu.
INLINE void put_cell_gradients(const slots& s, index i, int n, const local* gradients, int count, const local_mat3& R,
                               local_number w, local_number ratio, local* scaled_gradients) {
    for (int k = 0; any(s.width > k); ++k) {
        const index slot = slot_of(s, k, count - 1);
        const local_vec3 g = w * mul(R, slot_gradient(gradients, count, slot));
        const local_number row[4] = {g.x, g.y, g.z, ratio};
        put_slot(scaled_gradients, slot, i, n, row);
    }
}
