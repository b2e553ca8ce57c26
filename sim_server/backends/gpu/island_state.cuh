// SPDX-License-Identifier: MIT
// Bodies that touch each other on a GPU: islands, their state, and the arguments of all kernels (pairs.cu, island.cu, island_factor.cu).
//
// Bodies with rows between them are solved as one system (method: backends/cpu/native/passes.h, island.h); the others go on as
// contact_state.cuh says. A step with such bodies is
//
//     detection: pair_boxes, pair_trees, pair_sites, pair_edges; begin_ties, bind_edges where there are attachments or springs (ties.cu)
//     look_at_bodies, list_island_rows, find_islands, then the bodies that are alone
//     while there is something to do (conditions.py):
//         if there are islands to solve:
//             place_entries, fill_entries, island_start, and which start is the better one
//             while one is not over:
//                 island_law, island_balance, island_decide, island_prepare, coarse_matrix, invert_coarse for each body,
//                 while one iterates: island_update, island_factor, island_multiply, island_product, coarse_solve, island_finish
//                 island_update, island_multiply, island_residual, island_search, island_advance, island_settle
//         the paths found: pair_boxes, pair_trees, pair_sweep, edge_sweep, end_sweep, which after ROUNDS sweeps holds bodies apart
//         if they enter a body: look_at_bodies, list_island_rows, find_islands
//
// All islands go in step; a kernel does nothing for those that are in another phase. Sums have a fixed order: of thread blocks, which
// leave theirs in arrays, and of these in the kernel that reads them. What acts at a node is a list, sorted by row.
//
// With TIES, attachments and springs have rows after all others; a body that has one is solved here even if it is alone. keep_ties comes last.
// With OWN_SURFACES, bodies touch themselves, in rows whose other body is their own; one that has such rows is solved here, too.
#pragma once
#include "device_contact.cuh"
#include "edge_detection.cuh"
#include "hold_apart.cuh"
#include "own_surface.cuh"
#include "pass_choice.cuh"
#include "reaction.h"
#include "ties.cuh"

#ifdef TIES
constexpr bool HAS_TIES = true;
#else
constexpr bool HAS_TIES = false;
#endif
#ifdef OWN_SURFACES
constexpr bool HAS_OWN = true;
#else
constexpr bool HAS_OWN = false;
#endif
constexpr bool HAS_SINGLES = HAS_TIES || HAS_OWN;  // a body alone may be an island

constexpr int MODES = 6;          // rigid motions of a body: translations, then rotations about its first node
constexpr int CG_SUMS = 9;        // of an iteration
constexpr int BASE_SUMS = 36;     // Z^T A Z of a body
constexpr int LISTING_THREADS = 256;  // of find_islands, one thread block
constexpr int SEARCH_THREADS = 512;   // of island_search
constexpr int ERROR_BYTES = 256;      // of an IslandError (island_error.cuh), and room
constexpr double FACTOR_COST = 2;     // of an iteration with factors, over that of one with block Jacobi

enum IslandPhase {
    ISLAND_BEGINS = 0,    // the start is chosen next
    ISLAND_RESUMES = 1,   // a sweep has given it rows after its solve
    ISLAND_READY = 2,     // forces and stiffness are evaluated next
    ISLAND_SOLVES = 3,    // a pass is solved
    ISLAND_GOES_ON = 4,   // likewise, from where its residual was not as small as its iterations had it
    ISLAND_PASSED = 5,    // it is solved
    ISLAND_ENDED = 6,     // there is nothing left to solve, or no passes; its paths are looked at next
    ISLAND_LOST = 7,      // forces are not finite
    ISLAND_OVER = 8
};
enum Iterations { STANDS = 0, BEGINS_COARSE = 1, ITERATES = 2 };  // an island's conjugate gradients

struct IslandState {
    double given2;        // square of what residuals are relative to, the larger one of |b| and |b + i H^T f|
    double warm2, zero2;  // squares of the residual at the last solution and at zero
    double residual;      // with the law, relative; NaN: not known
    double solved;        // relative residual of the last solve
    double part;          // of the last solution that is taken
    double goal2, r2, last_true2;   // of a solve: squares of residuals
    double alpha, beta, gamma, pq, qq;
    double began, seconds;
    int phase, bodies, chunks, modes;  // numbers; modes: 0 if there are too many
    int set;              // 1: rows with in_set count as closed
    int last;             // 1: the solve under way is the last one
    int hold;             // 1: there was a pass since limits were set
    int rested;           // 1: the law held where the step began
    int zero;             // 1: it starts from zero
    int relist;           // 1: a sweep has filled rows against obstacles
    int rounds, passes, iterations, status, fallbacks;
    int stage;            // Iterations
    int pending;          // 1: x and r are updated by alpha, beta next
    int restart;          // 1: the next direction is the preconditioned residual
    int coarse;           // 1: rigid motions precondition
    int factors;          // 1: factors do, else block Jacobi
    PassBegin choice;     // of the two, for the solve; its factor_step is a sum over the bodies, 0: there is no factor
    double start2, residual_then;    // square of the residual at the start of the solve; relative, where it went over to the other one
    int switched_after, fell;        // iterations before that, 0: it did not; 1: a factor was of no use
    int own_iterations;   // of the solve
    int own_status;
};

struct IslandRow {        // what a solve needs of a row
    double stiffness[6];  // upper triangle of the force's slope times h^2, world frame [kg]
    double known[6];      // likewise, as a factor is to know it
    double impulse[3];    // i (lambda n + tau)
    double seen[3];       // H v of the last gather
    double force[3];      // stiffness times that
    double lever[8];      // (W, lever) of the vertex's body, then of the other one: u = W t + w x lever
};

struct Tally {            // what kernels leave for the graph and each other
    int islands, active, iterating, go, rounds, found, entries, alone, pairs, again, holds, unused[5];
};

struct IslandArguments {
    ContactArguments c;
    SurfaceTables t;
    EdgeTables e;
    const int* edge_body;        // (edges,)
    const int* row_body;         // (rows,)
    const PcgBody* bodies;       // (bodies,)
    const int* row_start;        // of A
    const int* columns;
    const double* gravity;       // (3,)
    const int* tree_height;      // (tree,) of a box over its triangles
    const int* leaf;             // (triangles,) boxes of one triangle each
    const int* leaf_start;       // (bodies + 1,) first one of each body; behind them own_tables
    int *near, *was_near, *touched;  // (bodies,) 1: its box meets another's, and bit MAY_TOUCH_ITSELF; in the last step; it got rows by a sweep
    real* ends;                  // (nodes, 3) where nodes come to
    real* ways;                  // (nodes, 3) how they come there, over dx_dv
    const double* none;          // (3,) no gravity
    int* dropped;                // (sites,)
    const real* mass;            // (nodes,) [kg]
    HeldPlace* held;             // (MOST_HELD (sites + edges),) where bodies are held apart, those of a body together
    int *held_list, *held_count; // likewise, those in use; (bodies,) places in a step
    const int* unheld;           // (bodies,) 1: no node is fixed
    const int* chunk_first;      // (bodies + 1,) first chunk of each body
    Tally* tally;                // (1,)
    IslandState* state;          // (bodies,) of islands
    int* bad;                    // (bodies,) 1: its forces are not finite
    int* label;                  // (bodies,) least body of its island
    int* island_of;              // (bodies,) -1: it is alone
    int* mode;                   // (bodies,) its first mode in the island; -1: it has none
    int *island_start, *island;  // (bodies + 1,), (bodies,) bodies by island
    int* free_body;              // (bodies,) likewise those with modes, from island_start on
    int *own_row, *own_rows, *pair_rows;  // (rows,) rows of each body that are not empty (own_list); (bodies,) their number; of pairs and ties
    double* earliest;            // (bodies,) entry of its rows
    IslandRow* row;              // (rows,)
    int* pair_list;              // (rows between bodies, 3) row and its bodies, those in use; -1: a tie of one body
    int *count, *start, *cursor; // (nodes,) entries of a node
    int* entry;                  // 4 row + corner, of rows between bodies and ties; those of a node together and sorted
    double *left, *r0, *r, *x, *p, *q, *z, *az;  // (nodes, 3) b - A y; right-hand side of the pass; conjugate gradients
    double* solution_product;    // (nodes, 3) A dy
    unsigned* finished_chunks;   // (bodies,) of islands, zero between launches
    const NodeChunk* product_chunks;  // (product_grid,) nodes of which each has three threads
    double* inverse;             // (nodes, 9) of diagonal blocks
    double* modes;               // (nodes, 3, MODES) A Z without contacts
    double* chunk_sums;          // (grid, CG_SUMS)
    double* coarse_sums;         // (grid, MODES) Z^T (r - A z)
    double* base_sums;           // (grid, BASE_SUMS)
    double* row_sums;            // (bodies,) rows that change; with ties (2, bodies), and those that are none
    double *coarse_a, *coarse_b; // (bodies, MODES, most_modes) rows of E, while it is inverted from one to the other
    int* coarse_well;            // (bodies,) of islands: 1: E is positive definite
    double* coefficient;         // (bodies, MODES)
    PassChoice* choice;          // (bodies,) of islands, kept by their first body
    PairSum* told;               // (capacity, bodies, most_told) on the host: what bodies exert on each other
    int* told_count;             // (capacity, bodies) on the host: other bodies of each; more than most_told have no place
    int bodies_count, most_modes, most_chunks, highest_tree, passes, bound_nodes, edges, most_told;
    Ties ties;                   // ties.first is the number of rows where there are none
    const int *bound_node, *bound_start;    // (bound_nodes,), (bound_nodes + 1,) nodes that may be bound, and first ties of each
    const int *bound_tie, *bound_other;     // those ties in order, and the bodies that they bind the node to
    const int* table_start;      // (tables + 1,) first ones in ties.order
    int* broken_on_host;         // (ties,)
    char* errors;                // (bodies, ERROR_BYTES) of islands; -DERRORS, as the next two
    double* before;              // (nodes, 3) solution when it was last looked at
    double* peaks;               // (grid, 2) largest squares of thread blocks: of z, and of the change of x
};

typedef SurfaceMotion<real, local> Motion;

__device__ __forceinline__ int island_of(const IslandArguments& a, int body) { return __ldcg(a.island_of + body); }

__device__ __forceinline__ bool is_tie(const IslandArguments& a, int row) { return HAS_TIES && row >= a.ties.first; }

// Of OWN_SURFACES: 1 if bodies touch each other, too, the length of OwnTables::start, and both arrays, one behind the other. They have no
// member of the arguments, so that kernels of other scenes stay as they are.
__device__ __forceinline__ const int* own_numbers(const IslandArguments& a) { return a.leaf_start + a.bodies_count + 1; }
__device__ __forceinline__ bool is_between(const IslandArguments& a) { return !HAS_OWN || own_numbers(a)[0]; }
__device__ __forceinline__ OwnTables own_tables(const IslandArguments& a) {
    const int* start = own_numbers(a) + 2;
    return {start, start + start[-1]};
}

// Whether it is a row between two bodies.
__device__ __forceinline__ bool is_pair(const IslandArguments& a, int row) {
    return is_tie(a, row) ? joins_bodies(a.ties, row - a.ties.first) : row >= a.t.pair_first;
}
// Body of a row; other: the other one, of a row between bodies.
__device__ __forceinline__ int body_of_row(const IslandArguments& a, int row, bool other) {
    if (is_tie(a, row)) return a.ties.body[2 * (row - a.ties.first) + other];
    return other ? __ldcg(a.t.obstacle + row) : a.row_body[row];
}
// True if a row is of a body with itself: it counts as one with a single body.
__device__ __forceinline__ bool is_own(const IslandArguments& a, int row) {
    return HAS_OWN && !is_tie(a, row) && row >= a.t.pair_first && a.t.obstacle[row] == a.row_body[row];
}
// True if a corner of a row is of the other one of its two bodies: of edges the last two.
__device__ __forceinline__ bool is_other_side(const IslandArguments& a, int row, int corner) {
    if (is_own(a, row)) return false;
    return is_pair(a, row) && corner > (!is_tie(a, row) && row >= a.e.start[0]);
}
// True if there are rows of contact between bodies.
__device__ __forceinline__ bool bodies_touch(const IslandArguments& a) { return !HAS_TIES || a.t.pair_first < a.ties.first; }
// True if a node is attached to a body: the two do not touch.
__device__ __forceinline__ bool is_bound(const IslandArguments& a, int node, int body) {
    return HAS_TIES && a.ties.bound[node] == body + 1;
}
// The same of two edges. edge, facing: their nodes
__device__ __forceinline__ bool are_bound(const IslandArguments& a, const int* edge, int body, const int* facing, int other) {
    return is_bound(a, edge[0], other) || is_bound(a, edge[1], other) || is_bound(a, facing[0], body) || is_bound(a, facing[1], body);
}
// f(first, last) of the rows of a body, each sort
template <class F> __device__ __forceinline__ void each_obstacle_range(const IslandArguments& a, int body, F f) {
    f(a.t.body_start[body], a.t.body_start[body + 1]);
    if (FACES) f(a.c.faces.start[body], a.c.faces.start[body + 1]);
}
template <class F> __device__ __forceinline__ void each_touching_range(const IslandArguments& a, int body, F f) {
    f(a.t.pair_first + a.t.body_start[body], a.t.pair_first + a.t.body_start[body + 1]);
    f(a.e.start[body], a.e.start[body + 1]);
}
template <class F> __device__ __forceinline__ void each_pair_range(const IslandArguments& a, int body, F f) {
    if (bodies_touch(a)) each_touching_range(a, body, f);
    if (HAS_TIES) f(a.ties.first + a.ties.start[body], a.ties.first + a.ties.start[body + 1]);
}

// Where the list of a body's rows that are not empty begins.
__device__ __forceinline__ int* own_list(const IslandArguments& a, int body) {
    return a.own_row + 2 * a.t.body_start[body] + (bodies_touch(a) ? a.e.start[body] - a.e.start[0] : 0) +
           (FACES ? a.c.faces.start[body] - a.c.faces.start[0] : 0) + (HAS_TIES ? a.ties.start[body] : 0);
}

// True if a row acts on one node, with weight 1: of a node against an obstacle.
__device__ __forceinline__ bool is_of_node(const IslandArguments& a, int row) { return !is_pair(a, row) && !is_face(a.c, row) && !is_tie(a, row); }

// f(node, weight, corner) of the corners that may move.
template <class F> __device__ __forceinline__ void each_corner(const IslandArguments& a, int row, F f) {
    if (is_of_node(a, row)) {
        const int node = a.c.node[row];
        if (a.c.free[node] != 0) f(node, 1.0, 0);
        return;
    }
    for (int k = 0; k < CORNERS; ++k) {
        const int node = a.t.corner[CORNERS * row + k];
        if (node >= 0 && a.c.free[node] != 0) f(node, a.t.weight[CORNERS * row + k], k);
    }
}

__device__ __forceinline__ void rotated(const local* R, const double* v, double* out) {
    for (int i = 0; i < 3; ++i) out[i] = (double)R[3 * i] * v[0] + (double)R[3 * i + 1] * v[1] + (double)R[3 * i + 2] * v[2];
}
__device__ __forceinline__ void rotated_back(const local* R, const double* v, double* out) {
    for (int i = 0; i < 3; ++i) out[i] = (double)R[i] * v[0] + (double)R[3 + i] * v[1] + (double)R[6 + i] * v[2];
}
__device__ __forceinline__ const local* rotation_of(const IslandArguments& a, int node) { return a.c.rotation + 9ll * node; }
__device__ __forceinline__ void copy3(const double* from, int node, double* to) {
    for (int k = 0; k < 3; ++k) to[k] = from[3ll * node + k];
}
__device__ __forceinline__ void stiff(const double* k, const double* u, double* out) {
    out[0] = k[0] * u[0] + k[1] * u[1] + k[2] * u[2];
    out[1] = k[1] * u[0] + k[3] * u[1] + k[4] * u[2];
    out[2] = k[2] * u[0] + k[4] * u[1] + k[5] * u[2];
}

// Lists the rows of a body that are not empty, in order, and counts them, and those that are not against obstacles, which come last. Done
// by a whole thread block.
__device__ void list_own_rows(const IslandArguments& a, int body) {
    int* list = own_list(a, body);
    int listed = 0, found = 0;
    auto add = [&](int first, int last) {
        found = list_range(a.c, first, last, list + listed);
        listed += found;
        __syncthreads();
    };
    each_obstacle_range(a, body, add);
    if (FACES && threadIdx.x == 0) a.c.faces.rows[body] = found;
    const int against = listed;
    each_pair_range(a, body, add);
    if (threadIdx.x > 0) return;
    a.own_rows[body] = listed;
    a.pair_rows[body] = listed - against;
}

// Sums of an island over what the chunks of its bodies have left; in all threads.
template <int THREADS_OF_BLOCK = CONTACT_THREADS, int N> __device__ void sum_island(const IslandArguments& a, int island, const double* partial, double (&sum)[N]) {
    const int first = a.island_start[island], bodies = a.island_start[island + 1] - first;
    for (int n = 0; n < N; ++n) sum[n] = 0;
    for (int k = threadIdx.x; k < bodies * a.most_chunks; k += THREADS_OF_BLOCK) {
        const int body = a.island[first + k / a.most_chunks], chunk = a.chunk_first[body] + k % a.most_chunks;
        if (chunk >= a.chunk_first[body + 1]) continue;
        for (int n = 0; n < N; ++n) sum[n] += __ldcg(partial + (long long)N * chunk + n);
    }
    sum_block<THREADS_OF_BLOCK>(sum);
}
