// SPDX-License-Identifier: MIT
// Sums at nodes and blocks what corotational strain cells have at their slots (corotational_cells.cu): corotational_nodes.cu and
// corotational_blocks.cu for cells with any number of nodes. Gathers: no two items write to the same place.
#include "corotational_tangent.cuh"

struct CellNodes {
    int n;                          // nodes
    const int* start;               // (n + 1,) into corners
    const int* corners;             // (start[n],) slots of the cells at the node
    const int* owners;              // (start[n],) the cells
    const local* nodal_impulse;     // (slots, 3) [N s]
    const local* scaled_gradients;  // (slots, 4) g_a, lambda_c / mu
    const local* quaternion;        // (cells, 4) unit quaternions
    own<real> b;                    // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;               // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;                // (n, 10) in, out: upper triangle of the sum of q q^T, q the cells' rotations
};

template <class P> INLINE void add_corner(const P& p, int k, local* sum) {
    const local* f = p.nodal_impulse + 3 * p.corners[k];
    local g[4], q[4];
    get_row(p.scaled_gradients, p.corners[k], g);
    get_row(p.quaternion, p.owners[k], q);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    add_own(sum + 3, g);
    add_quaternion_product(sum + 9, q);
}

template <class P> INLINE void put_corners(const P& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, row_at<10>(p.mean, i, m) + sum[9 + m]);
}

INLINE void gather_add(const CellNodes& p, int, int k, local* sum) { add_corner(p, k, sum); }
INLINE void gather_put(const CellNodes& p, int i, const local* sum) { put_corners(p, i, sum); }
SUM_KERNEL(gather, CellNodes, 19)

struct ExactCellNodes {
    int n;                          // nodes
    const int* start;               // (n + 1,) into corners
    const int* corners;             // (start[n],) slots of the cells at the node
    const int* owners;              // (start[n],) the cells
    const local* nodal_impulse;     // (slots, 3) [N s]
    const local* scaled_gradients;  // (slots, 4) g_a, lambda_c / mu
    const local* twist;             // (cells, 6) E
    const local* quaternion;        // (cells, 4) unit quaternions
    own<real> b;                    // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;               // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;                // (n, 10) in, out: upper triangle of the sum of q q^T, q the cells' rotations
};

INLINE void gather_exact_add(const ExactCellNodes& p, int, int k, local* sum) {
    add_corner(p, k, sum);
    local g[4];
    get_row(p.scaled_gradients, p.corners[k], g);
    add_own_twist(sum + 3, g, p.twist + 6 * p.owners[k]);
}
INLINE void gather_exact_put(const ExactCellNodes& p, int i, const local* sum) { put_corners(p, i, sum); }
SUM_KERNEL(gather_exact, ExactCellNodes, 19)

struct CellForceNodes {
    int n;                       // nodes
    const int* start;            // (n + 1,) into corners
    const int* corners;          // (start[n],) slots of the cells at the node
    const int* owners;           // (start[n],) the cells
    const local* nodal_impulse;  // (slots, 3) [N s]
    const local* quaternion;     // (cells, 4) unit quaternions
    own<real> b;                 // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> mean;             // (n, 10) in, out: upper triangle of the sum of q q^T
};

INLINE void gather_frames_add(const CellForceNodes& p, int, int k, local* sum) {
    const local* f = p.nodal_impulse + 3 * p.corners[k];
    local q[4];
    get_row(p.quaternion, p.owners[k], q);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    add_quaternion_product(sum + 3, q);
}

INLINE void gather_frames_put(const CellForceNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 10; ++m) row_put<10>(p.mean, i, m, row_at<10>(p.mean, i, m) + sum[3 + m]);
}

SUM_KERNEL(gather_frames, CellForceNodes, 13)

struct CellBlocks {
    int n;                          // blocks above the diagonal
    int accumulate;                 // 0: write, 1: add to what another effect wrote
    const int* start;               // (n + 1,) into pairs
    const int* pairs;               // (start[n], 2) slots of a cell at the block's row and column
    const local* scaled_gradients;  // (slots, 4) g_a, lambda_c / mu
    own<local> sums;                // (n, 9) out, world frame, row major [kg]
};

template <class P> INLINE void put_blocks(const P& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, p.accumulate ? row_at<9>(p.sums, i, m) + sum[m] : sum[m]);
}

INLINE void blocks_add(const CellBlocks& p, int, int k, local* s) {
    local a[4], b[4];
    get_row(p.scaled_gradients, p.pairs[2 * k], a);
    get_row(p.scaled_gradients, p.pairs[2 * k + 1], b);
    add_block(s, a, b);
}
INLINE void blocks_put(const CellBlocks& p, int i, const local* sum) { put_blocks(p, i, sum); }
SUM_KERNEL(blocks, CellBlocks, 9)

struct ExactCellBlocks {
    int n;                          // blocks above the diagonal
    int accumulate;                 // 0: write, 1: add to what another effect wrote
    const int* start;               // (n + 1,) into pairs
    const int* pairs;               // (start[n], 2) slots of a cell at the block's row and column
    const int* owners;              // (start[n],) the cells
    const local* scaled_gradients;  // (slots, 4) g_a, lambda_c / mu
    const local* twist;             // (cells, 6) E
    own<local> sums;                // (n, 9) out, world frame, row major [kg]
};

INLINE void blocks_exact_add(const ExactCellBlocks& p, int, int k, local* s) {
    local a[4], b[4];
    get_row(p.scaled_gradients, p.pairs[2 * k], a);
    get_row(p.scaled_gradients, p.pairs[2 * k + 1], b);
    add_block(s, a, b);
    add_twist(s, a, b, p.twist + 6 * p.owners[k]);
}
INLINE void blocks_exact_put(const ExactCellBlocks& p, int i, const local* sum) { put_blocks(p, i, sum); }
SUM_KERNEL(blocks_exact, ExactCellBlocks, 9)

// Of cells that have a dilatation alone, whose usual tangent is their patch's: the impulses, and the twists of the exact one.
struct TwistNodes {
    int n;                          // nodes
    const int* start;               // (n + 1,) into corners
    const int* corners;             // (start[n],) slots of the cells at the node
    const int* owners;              // (start[n],) the cells
    const local* nodal_impulse;     // (slots, 3) [N s]
    const local* scaled_gradients;  // (slots, 4) g_a
    const local* twist;             // (cells, 6) E
    own<real> b;                    // (n, 3) in, out: right-hand side, world frame [N s]
    own<local> block;               // (n, 6) in, out: upper triangle of the node's own block of A, world frame [kg]
};

INLINE void gather_twists_add(const TwistNodes& p, int, int k, local* sum) {
    const local* f = p.nodal_impulse + 3 * p.corners[k];
    local g[4];
    get_row(p.scaled_gradients, p.corners[k], g);
    for (int m = 0; m < 3; ++m) sum[m] += f[m];
    add_own_twist(sum + 3, g, p.twist + 6 * p.owners[k]);
}

INLINE void gather_twists_put(const TwistNodes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) row_put<3>(p.b, i, m, row_at<3>(p.b, i, m) + sum[m]);
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, row_at<6>(p.block, i, m) + sum[3 + m]);
}

SUM_KERNEL(gather_twists, TwistNodes, 9)

struct TwistBlocks {
    int n;                          // blocks above the diagonal
    const int* start;               // (n + 1,) into pairs
    const int* pairs;               // (start[n], 2) slots of a cell at the block's row and column
    const int* owners;              // (start[n],) the cells
    const local* scaled_gradients;  // (slots, 4) g_a
    const local* twist;             // (cells, 6) E
    own<local> sums;                // (n, 9) in, out, world frame, row major [kg]
};

INLINE void twist_blocks_add(const TwistBlocks& p, int, int k, local* s) {
    local a[4], b[4];
    get_row(p.scaled_gradients, p.pairs[2 * k], a);
    get_row(p.scaled_gradients, p.pairs[2 * k + 1], b);
    add_twist(s, a, b, p.twist + 6 * p.owners[k]);
}

INLINE void twist_blocks_put(const TwistBlocks& p, int i, const local* sum) {
    for (int m = 0; m < 9; ++m) row_put<9>(p.sums, i, m, row_at<9>(p.sums, i, m) + sum[m]);
}

SUM_KERNEL(twist_blocks, TwistBlocks, 9)
