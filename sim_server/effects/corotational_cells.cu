// SPDX-License-Identifier: MIT
// Corotational strain cells in patches (formulas: _cells.py): deformation of the cells, then, once patches have their mean
// dilatation (corotational_patches.cu), nodal impulses and scaled gradients.
#define WIDE
#include "corotational_twist.cuh"
#include "strain_cells.cuh"

struct CorotationalCells {
    int n;                   // cells
    int slots;               // of all cells, the last one of none
    const int* first;        // (n,) slot of the first node
    const int* width;        // (n,) slots of the cell
    const int* nodes;        // (slots,)
    const real* x;           // (nodes, 3) positions [m]
    const real* v;           // (nodes, 3) world.damping_velocity [m/s]
    const local* gradients;  // (3, slots) [1/m]
    const local* volume;     // (n,) V [m3], 0 where the cell has a deviator alone
    local* quaternion;       // (n, 4) out: unit quaternion of the nearest rotation of F, w first; of `measure_near` also in
    local* strain;           // (15, n) out: S = R^T F, its upper triangle, and T = R^T dF/dt [1/s], row major
    local* dilatation;       // (n, 2) out: V tr(S - I) [m3], V tr T [m3/s]
};

INLINE slots cell_slots(const int* first, const int* width, index i) { return {at(first, i), at(width, i)}; }

INLINE void put_strain(const CorotationalCells& p, index i, const local_mat3& F, const local_mat3& G,
                       quaternion<local_number> q) {
    const local_mat3 Rt = transposed(rotation_matrix(q)), S = mul(Rt, F), T = mul(Rt, G);
    const local half = 0.5;
    const local_number upper[6] = {S.m[0], half * (S.m[1] + S.m[3]), half * (S.m[2] + S.m[6]),
                                   S.m[4], half * (S.m[5] + S.m[7]), S.m[8]};
    for (int k = 0; k < 6; ++k) put(p.strain + k * (long long)p.n, i, upper[k]);
    for (int k = 0; k < 9; ++k) put(p.strain + (6 + k) * (long long)p.n, i, T.m[k]);
    const local_number volume = at_items(p.volume, i), both[2] = {volume * (trace(S) - 3), volume * trace(T)};
    put_row(p.dilatation, i, p.n, both);
    const local_number wxyz[4] = {q.w, q.x, q.y, q.z};
    put_row(p.quaternion, i, p.n, wxyz);
}

KERNEL(measure, CorotationalCells) {
    local_mat3 F, G;
    cell_gradients(cell_slots(p.first, p.width, i), p.nodes, p.gradients, p.slots, p.x, p.v, F, G);
    put_strain(p, i, F, G, nearest_quaternion(F));
}

// The same, with the rotation sought from the last one of this array.
KERNEL(measure_near, CorotationalCells) {
    local_number near[4];
    for (int k = 0; k < 4; ++k) near[k] = at(p.quaternion, 4 * i + k);
    local_mat3 F, G;
    cell_gradients(cell_slots(p.first, p.width, i), p.nodes, p.gradients, p.slots, p.x, p.v, F, G);
    put_strain(p, i, F, G, nearest_quaternion(F, {near[0], near[1], near[2], near[3]}));
}

struct CorotationalCellImpulses {
    int n;                               // elements: the cells, after their patches
    int slots;                           // of all cells
    int exact;                           // 1: the damping of the stiffness is that of the exact tangent
    const int* first;                    // (n,) slot of the first node
    const int* width;                    // (n,) slots of the cell
    const local* gradients;              // (3, slots) [1/m]
    const int* patch;                    // (n,) of the cell
    const local* mean_dilatation;        // (patches, 2) theta [-], its rate [1/s]
    const local* moduli;                 // (4, n) mu V, kappa V, lambda_c V, 0 where the cell has none, and m V [Pa m3]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2], c world.dx_dv, beta the Rayleigh damping of the stiffness
    local h;                             // world.force_coefficient: the time step in backward Euler [s]
    const local* quaternion;             // (n, 4) unit quaternions
    const local* strain;                 // (15, n) S and T
    local* nodal_impulse;                // (slots, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

template <class P> INLINE void get_strain(const P& p, index i, local_mat3& S, local_mat3& T) {
    local_number upper[6];
    for (int k = 0; k < 6; ++k) upper[k] = at_items(p.strain + k * (long long)p.n, i);
    for (int k = 0; k < 9; ++k) T.m[k] = at_items(p.strain + (6 + k) * (long long)p.n, i);
    S = symmetric(upper[0], upper[1], upper[2], upper[3], upper[4], upper[5]);
}

template <class P> INLINE local_mat3 cell_rotation(const P& p, index i) {
    return rotation_matrix(quaternion<local_number>{at(p.quaternion, 4 * i), at(p.quaternion, 4 * i + 1),
                                                    at(p.quaternion, 4 * i + 2), at(p.quaternion, 4 * i + 3)});
}

template <class P> INLINE local_number cell_lambda(const P& p, index i) { return at_items(p.moduli + 2 * (long long)p.n, i); }

// m V, m being mu of the material, which scales gradients.
template <class P> INLINE local_number cell_modulus(const P& p, index i) { return at_items(p.moduli + 3 * (long long)p.n, i); }

// Stress times V in the frame of the cell: its own, and the patch's pressure.
template <class P> INLINE local_mat3 cell_stress(const P& p, index i, const local_mat3& S, const local_mat3& T) {
    const local_number k = at_items(p.stiffness_coefficient, i), mu = at_items(p.moduli, i), kappa = at_items(p.moduli + p.n, i);
    const index patch = at(p.patch, i);
    const local_number theta = at(p.mean_dilatation, 2 * patch), rate = at(p.mean_dilatation, 2 * patch + 1);
    local_mat3 stress = hooke(S, T, p.h, k, cell_lambda(p, i), mu);
    const local_number pressure = kappa * (p.h * theta + k * rate);
    stress.m[0] += pressure; stress.m[4] += pressure; stress.m[8] += pressure;
    return stress;
}

template <class P> INLINE local_mat3 cell_twists(const P& p, index i, const local_mat3& S) {
    const local_number m = 1 / cell_modulus(p, i), mu = m * at_items(p.moduli, i), kappa = m * at_items(p.moduli + p.n, i);
    const local_number theta = at(p.mean_dilatation, 2 * at(p.patch, i));
    return twists(S, mu, kappa * theta + m * cell_lambda(p, i) * (trace(S) - 3) - 2 * mu);
}

KERNEL(impulses, CorotationalCellImpulses) {
    local_mat3 S, T;
    get_strain(p, i, S, T);
    local_mat3 P = cell_stress(p, i, S, T);
    if (p.exact) add_spin_stress(P, T, cell_twists(p, i, S), at_items(p.stiffness_coefficient, i) * cell_modulus(p, i));
    P = mul(cell_rotation(p, i), P);
    put_cell_impulses(cell_slots(p.first, p.width, i), i, p.n, p.gradients, p.slots, P, p.nodal_impulse);
}

struct CorotationalCellElements {
    int n;                               // elements: the cells, after their patches
    int slots;                           // of all cells
    const int* first;                    // (n,) slot of the first node
    const int* width;                    // (n,) slots of the cell
    const local* gradients;              // (3, slots) [1/m]
    const int* patch;                    // (n,) of the cell
    const local* mean_dilatation;        // (patches, 2) theta [-], its rate [1/s]
    const local* moduli;                 // (4, n) mu V, kappa V, lambda_c V, 0 where the cell has none, and m V [Pa m3]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2]
    local h;                             // world.force_coefficient [s]
    const local* quaternion;             // (n, 4) unit quaternions
    const local* strain;                 // (15, n) S and T
    local* scaled_gradients;             // (slots, 4) out: g_a = sqrt(h (c + beta) m V) R G_a, and lambda_c / m
    local* nodal_impulse;                // (slots, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

template <class P> INLINE void put_cell_results(const P& p, index i, const local_mat3& stress, const local_mat3& R) {
    const slots s = cell_slots(p.first, p.width, i);
    put_cell_impulses(s, i, p.n, p.gradients, p.slots, mul(R, stress), p.nodal_impulse);
    const local_number m = cell_modulus(p, i), w = sqrt(at_items(p.stiffness_coefficient, i) * m);
    put_cell_gradients(s, i, p.n, p.gradients, p.slots, R, w, cell_lambda(p, i) / m, p.scaled_gradients);
}

KERNEL(elements, CorotationalCellElements) {
    local_mat3 S, T;
    get_strain(p, i, S, T);
    put_cell_results(p, i, cell_stress(p, i, S, T), cell_rotation(p, i));
}

struct CorotationalExactCellElements {
    int n;                               // elements: the cells, after their patches
    int slots;                           // of all cells
    const int* first;                    // (n,) slot of the first node
    const int* width;                    // (n,) slots of the cell
    const local* gradients;              // (3, slots) [1/m]
    const int* patch;                    // (n,) of the cell
    const local* mean_dilatation;        // (patches, 2) theta [-], its rate [1/s]
    const local* moduli;                 // (4, n) mu V, kappa V, lambda_c V, 0 where the cell has none, and m V [Pa m3]
    const local* stiffness_coefficient;  // (n,) h (c + beta) [s2]
    local h;                             // world.force_coefficient [s]
    const local* quaternion;             // (n, 4) unit quaternions
    const local* strain;                 // (15, n) S and T
    local* scaled_gradients;             // (slots, 4) out: as above
    local* twist;                        // (n, 6) out: upper triangle of E (corotational_exact.cu)
    local* nodal_impulse;                // (slots, 3) out: h f_a + h (c + beta) (K v)_a [N s]
};

KERNEL(exact_elements, CorotationalExactCellElements) {
    local_mat3 S, T;
    get_strain(p, i, S, T);
    local_mat3 P = cell_stress(p, i, S, T), E = cell_twists(p, i, S), R = cell_rotation(p, i);
    add_spin_stress(P, T, E, at_items(p.stiffness_coefficient, i) * cell_modulus(p, i));
    put_cell_results(p, i, P, R);
    E = mul(R, mul(E, transposed(R)));
    const local_number row[6] = {E.m[0], E.m[1], E.m[2], E.m[4], E.m[5], E.m[8]};
    put_row(p.twist, i, p.n, row);
}

struct CorotationalCellEnergy {
    int n;                   // cells
    int slots;               // of all cells
    const int* first;        // (n,) slot of the first node
    const int* width;        // (n,) slots of the cell
    const int* nodes;        // (slots,)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (3, slots) [1/m]
    const local* volume;     // (n,) V [m3], 0 where the cell has a deviator alone
    const local* moduli;     // (4, n) mu V, kappa V, lambda_c V, 0 where the cell has none, and m V [Pa m3]
    local* dilatation;       // (n,) out: V tr(S - I) [m3]
    local* energy;           // (n,) out: V (mu |dev(S - I)|^2 + (lambda_c / 2 + mu / 3) tr(S - I)^2), S = R^T F [J]
};

KERNEL(energy, CorotationalCellEnergy) {
    typedef exact_number T;  // as that of corotational.cu
    const mat<T> F = cell_gradient<T>(cell_slots(p.first, p.width, i), p.nodes, p.gradients, p.slots, p.x);
    const mat<T> S = mul(transposed(nearest_rotation(F)), F);
    const T trace3 = trace(S) - 3, mean = (entry<T>)(1.0 / 3) * trace3 + 1;
    T square = T{};
    for (int k = 0; k < 9; ++k) {
        T e = k % 4 == 0 ? S.m[k] - mean : S.m[k];
        square += e * e;
    }
    const T mu = at_items(p.moduli, i), bulk = (entry<T>)0.5 * cell_lambda(p, i) + (entry<T>)(1.0 / 3) * mu;
    put(p.energy, i, (local_number)(mu * square + bulk * trace3 * trace3));
    put(p.dilatation, i, (local_number)(at_items(p.volume, i) * trace3));
}
