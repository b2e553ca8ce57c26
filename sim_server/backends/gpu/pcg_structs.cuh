// SPDX-License-Identifier: MIT
// Data of the persistent solver (pcg.cu). Python reads its layouts (declarations.py).
#pragma once
#include "kinds.h"
#include "step_results.cuh"

#ifndef real
#define real double
#endif

// 32 entries of the vector that a phase multiplies, one per lane of a warp, and their source.
struct __align__(16) WarpSegment {
    int kind;  // 0: formed (residual minus contributions), 1: formed earlier, 2: solved, through `boundary`
    int from;  // packed position, or index in `boundary`
    int to;    // index in the vector
    int keep;  // 2 valid + 1 if this block also stores it for others (kind 0); entries from `valid` on are zero
};

// Eight or sixteen rows of a part's matrix: `chunks` chunks of 8 rows x 32 columns from `chunk` on, then those of the other
// eight rows. x: first entry of the vector; out: first result; elsewhere, -DHELPED: the other device reads the results, too; before: chunks
// of the tiles before it in its list.
struct __align__(16) Tile { int chunk, x, chunks, out, rows, elsewhere, before, unused; };

// First and number of the segments, tiles and chunks of a thread block.
struct BlockRanges { int segment, segments, tile, tiles, chunk, chunks, unused[2]; };

// Partitioned inverse over the thread blocks of a body (inverse/plan.py). Lists by thread block and phase.
struct DevicePlan {
    int phases, blocks, groups, size;
    const BlockRanges* block_ranges;  // (blocks,)
    const int* lists;                 // (blocks, 3 phases + 2) of each phase: first segment (and the end), first tile (and the end), both
                                      // within the part; first segment that is not formed here
    const WarpSegment* segments;
    const Tile* tiles;
    const int* index;                 // (segments, 32) of each entry: its position (kinds 1 and 2), or the first of its contributions
                                      // and, in the upper 8 bits, their number (kind 0)
    const int* target;                // position of each contribution in PcgBody.contributed
    const int* place;                 // (nodes,) packed position of a node
    int entries;                      // of the longest vector of a phase
    int contributions;                // words of PcgBody.contributed
};

template <class T> struct FlagWord;  // block_group.cuh

// Rows of A of one thread block, and the nodes that they read (row_partition.ROW_RANGE).
// -DALONE: upper: blocks of A on and above the diagonal; window: most of them that a slab and those on their way need (spmv.cuh),
// 0 if they are more than that allows.
struct RowRange { int body, index, begin, own, halo_first, halo, block_first, blocks, upper, window; };

struct PcgBody {
    int first, nodes;              // range of the nodes of the scene
    int blocks;                    // number of thread blocks
    int kind, max_iterations, warm_start, probe;
    int first_range;               // first of its thread blocks in PcgArguments.row_ranges
    double tolerance;
    double position, trust, dx_dv; // see SolveSettings (backends/cpu/native/pcg.h)
    double step_budget, budget;    // likewise; -DBUDGETS
    int most_linearizations, unused;  // likewise
    long long factor_step;         // step of the matrix of the factor
    const DevicePlan* plan;        // null: no factor yet
    const uint4* matrix;           // chunks
    const float* scale;            // (size + 1,) d: the inverse is d_i stored_ij d_j; the last is the largest
    FlagWord<float>* residual;     // (2, size + 32) d r
    FlagWord<float>* product;      // (size + 32,) d A p
    FlagWord<float>* z;            // (size + 32,)
    FlagWord<float>* formed;       // (size + 32,)
    FlagWord<float>* solved;       // (size + 32,) z / d
    FlagWord<float>* contributed;  // contributions of parts below
    int planes;                    // float16 numbers per entry of the inverse
    int helper;                    // -DHELPED: row in Help.far; 0: no other device has a part of this inverse
};

// Wall time of a body's search, on the device's clock, as it took last (step_budget.cuh).
struct TrialClock {
    long long solved, decided;     // ends of the last solve and of the last decision on a trial [ns]
    double forces, blocks;         // from a solve to the decision on its trial, and on to the next solve [s]
    double judging;                // of a solve that only judged a state [s]
};

struct PcgArguments {
    const PcgBody* bodies;
    int count, capacity;           // bodies; results kept per body
    const int* row_start;
    const real* values;            // (blocks, 3, 3)
    const real* b;                 // (nodes, 3)
    real* y;                       // (nodes, 3) in: initial guess; out: solution
    const int* order;              // (2, bodies) those with thread blocks of their own, then the pool (pool_order.cuh); in even and
                                   // in odd steps
    int pooled, grid;              // number of bodies in the pool, which free thread blocks take one by one; number of thread blocks
    const RowRange* row_ranges;    // of all thread blocks of all bodies
    const int* initial_range;      // (grid,) range with which each thread block begins, -1: the pool
    const int* halo;               // lists of nodes that a thread block reads, its own first
    const int* local_column;       // (blocks of A,) column as an index into that list; -DALONE: see spmv.cuh
    const int* upper_start;        // -DALONE: (nodes + bodies,) blocks on and above the diagonal before each row of its body
    const int* lowest_row;         // -DALONE: (nodes,) first row of the body whose blocks this row and the later ones need
    real* halo_values;             // (halo, 3) used if they do not fit into shared memory
    int* halo_position;            // (halo,) likewise
    real* own_vectors;             // (3, nodes, 3) x, r, q likewise; -DERRORS: (4, nodes, 3), x at the last look, too
    FlagWord<real>* z;             // (nodes, 3) without a factor
    real* diagonal;                // (nodes, 9) inverses of the diagonal blocks
    FlagWord<double>* block_sums;  // (bodies, 2, 4, grid) partial sums; -DERRORS: then (bodies, 2, grid) largest values
    unsigned* exchange_number;     // (bodies,) of the last exchange, counted from the first step on
    unsigned* pool_counter;        // (1,) zero at launch; bodies of the pool that were taken
    const long long* step;         // number of completed steps, which selects the slot of the result
    PcgResult* results;            // (capacity, bodies)
    const long long* begun;        // (1,) time at which the step began [ns]
    TrialClock* clocks;            // (bodies,)
    const int* moving;             // (bodies,) 0: the body rests (kernels/nodes.cu)
    const real* at_rest;           // -DCUTS: (nodes,) 1 at nodes without elements (cut_nodes.cuh)
    const long long* split_step;   // -DSPLITS: (bodies,) steps completed when the body was split last: older factors are not used
    int nodes, shared;             // of the scene; bytes of dynamic shared memory
    long long* slow;               // -DSMOOTHED: (bodies,) what solves leave to later ones (smoothing_state.cuh)
    long long* unfinished;         // likewise: (1,) step of the last solve that goes on smoothed
    double* largest;               // likewise: (bodies,) estimate of the largest eigenvalue of D^-1 A, D its diagonal blocks; 0: none yet
};
