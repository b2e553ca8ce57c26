// SPDX-License-Identifier: MIT
// Tetrahedra of a law W = W_s(I1, I2, J) + U(J) whose patches share the change of volume (formulas: _hyperelastic_patches.py). LAW
// is the text of the law, whose constants are those of W_s here. First the changes of volume, then, once patches have their U'
// (hyperelastic_patches.cu), all as in hyperelastic.cu, of W_s + U' J.
#define WIDE
#include "hyperelastic_element.cuh"
#include LAW

struct HyperelasticVolumes {
    int n;                   // cells: the elements, before their patches
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) positions [m]
    const real* v;           // (nodes, 3) what the tangent is applied to [m/s]
    const local* gradients;  // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const local* volume;     // (n,) [m3]
    local* dilatation;       // (n, 2) out: V (J - 1) [m3], V dJ/dt [m3/s]
};

KERNEL(measure, HyperelasticVolumes) {
    index tet[4];
    local_vec3 v[3];
    Tetrahedron<local_number> t = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    local_number volume = at_items(p.volume, i), rate = dot(t.area[1], v[0]) + dot(t.area[2], v[1]) + dot(t.area[3], v[2]);
    const local_number row[2] = {volume * (t.J - 1), volume * rate};
    put_row(p.dilatation, i, p.n, row);
}

struct HyperelasticPatchElements {
    int n;                               // elements: the cells, after their patches
    int projection;                      // of the tangent
    const int* tets;                     // (n, 4) nodes
    const int* patch;                    // (n,)
    const real* x;                       // (nodes, 3) positions [m]
    const real* v;                       // (nodes, 3) what the tangent is applied to [m/s]
    const local* gradients;              // (9, n) [1/m]
    const local* volume;                 // (n,) [m3]
    const local* constants;              // (CONSTANTS, n) of W_s
    const local* floor;                  // (n,) J below which the law goes on as a parabola, 0: J <= 0 is refused
    const local* pressure;               // (patches, 2) U' [Pa], U'' times the rate of the mean of J [Pa/s]
    const local* stiffness_coefficient;  // (n,) factor of the tangent [s2]
    local h;                             // factor of the force [s]
    const double* clock;                 // (1,) [s]
    double* refused;                     // (n, 2) in, out: when the element was first refused [s], -1: never; its J then
    local* corners;                      // (4, n, 9) out: h f_a - factor (K v)_a [N s], upper triangle of factor K_aa without U'' [kg]
    local* edges;                        // (6, n, 9) out: factor K_ab without U'', a < b [kg]
    local* areas;                        // (4, n, 3) out: V dJ/dx_a [m2]
};

KERNEL(elements, HyperelasticPatchElements) {
    index tet[4], patch = at(p.patch, i);
    local_vec3 v[3];
    Tetrahedron<local_number> t = element_at(p, i, tet);
    field_edges(p.v, tet, v);
    local_number c[CONSTANTS], volume = at_items(p.volume, i), floor = at_items(p.floor, i), k = volume * at_items(p.stiffness_coefficient, i);
    constants_at(p, i, c);
    mat<local_number> left = mul(t.F, transposed(t.F));
    Invariants<local_number> q = invariants<HAS>(left, t.J);
    Slopes<local_number> w = slopes(c, q, floor);
    w.wJ += row_at<2>(p.pressure, patch, 0);

    local_vec3 impulse[4];
    forces<HAS>(w, q, left, t, -p.h * volume, impulse);
    const local_number damping = -k * row_at<2>(p.pressure, patch, 1);
    UNROLL for (int a = 0; a < 4; ++a) {
        const local_vec3 area = volume * t.area[a];
        put_row(p.areas + 3 * (long long)p.n * a, i, p.n, {area.x, area.y, area.z});
        impulse[a] = impulse[a] + damping * t.area[a];
    }
    put_element<HAS, REFUSES>(p, i, t, q, w, left, k, floor, v, impulse);
}

struct HyperelasticPatchForces {
    int n;                   // elements: the cells, after their patches
    const int* tets;         // (n, 4) nodes
    const int* patch;        // (n,)
    const real* x;           // (nodes, 3) positions [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* constants;  // (CONSTANTS, n) of W_s
    const local* floor;      // (n,)
    const local* pressure;   // (patches, 2)
    local h;                 // factor of the force [s]
    const double* clock;     // (1,) [s]
    double* refused;         // (n, 2) in, out
    local* impulses;         // (4, n, 3) out: h f_a [N s]
};

// The forces of `elements` alone, without a tangent.
KERNEL(forces, HyperelasticPatchForces) {
    index tet[4], patch = at(p.patch, i);
    Tetrahedron<local_number> t = element_at(p, i, tet);
    local_number c[CONSTANTS], floor = at_items(p.floor, i);
    constants_at(p, i, c);
    mat<local_number> left = mul(t.F, transposed(t.F));
    Invariants<local_number> q = invariants<HAS>(left, t.J);
    Slopes<local_number> w = slopes(c, q, floor);
    w.wJ += row_at<2>(p.pressure, patch, 0);
    local_vec3 impulse[4];
    forces<HAS>(w, q, left, t, -p.h * at_items(p.volume, i), impulse);
    put_impulses<REFUSES>(p, i, t.J, floor, impulse);
}

struct HyperelasticPatchEnergy {
    int n;                   // cells: the elements, before their patches
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* constants;  // (CONSTANTS, n) of W_s
    const local* floor;      // (n,)
    local* dilatation;       // (n,) out: V (J - 1) [m3]
    local* energy;           // (n,) out: V W_s [J]; NaN where the law is not defined
};

KERNEL(energy, HyperelasticPatchEnergy) {  // exact_number: as that of hyperelastic.cu
    index tet[4];
    Tetrahedron<exact_number> t = element_at<exact_number>(p, i, tet);
    exact_number c[CONSTANTS], floor = at_items(p.floor, i), volume = at_items(p.volume, i);
    constants_at(p, i, c);
    exact_number W = density(c, invariants<HAS>(mul(t.F, transposed(t.F)), t.J), floor);
    if constexpr (REFUSES) W = t.J <= 0 && floor == 0 ? no_number<exact_number>() : W;
    put(p.energy, i, (local_number)(volume * W));
    put(p.dilatation, i, (local_number)(volume * (t.J - 1)));
}
