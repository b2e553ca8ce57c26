// SPDX-License-Identifier: MIT
// Low-rank correction of a factor on a GPU for changes of own blocks of A since its matrix: grabs (effects/touch.cu) and contacts with
// obstacles (contact.cu) that began or ended. A GPU applies an explicit inverse P, so the formula of Sherman, Morrison and Woodbury
// stands behind it, not between two triangular solves as in backends/cpu/native/woodbury.h. With U the columns of the identity at the
// nodes concerned and C the differences of their blocks,
//     (P^-1 + U C U')^-1 = P - V M V',    V = P U,  M = C (I + U'V C)^-1.
// V'r = U'P r are values of P r, which each thread block can read: z = P r - V M t with t = U'P r, and z . r = r'P r - t . M t, so that an
// iteration has no more exchanges than without.
//
// V is made of unit vectors, which pcg.cu passes through the preconditioner before the first iteration; its columns remain until the next
// factor, as nodes come and go. What a factor knows of grabs follows from the changes of each node's spring, read backwards; of contacts
// from a history of what they added to the last matrices.
#pragma once
#include "host_device.cuh"

#ifndef real
#define real double
#endif

constexpr int HISTORY = 128;        // matrices of which what contacts added is kept: an older factor is not corrected for contacts
constexpr int SPRING_CHANGES = 4;   // of a node that are kept: a factor is not corrected there for more
constexpr int MOST_CORRECTED = 64;  // nodes of a body
// Relative to the node's own block: a node with a smaller difference gets no columns, which would cost more than they save (each as much
// as half an iteration, for every factor), and differences below NOTHING are none.
constexpr double LEAST_SHARE = 0.3, NOTHING = 0.004;
// Larger springs, in blocks, are corrected as this much, and of a spring that has gone a part remains: the inverse has float16 numbers,
// or pairs of them (PcgBody.planes).
constexpr double STIFF[2] = {1e4, 1e5}, REMAINS[2] = {1e-3, 1e-4};

struct SpringHistory {              // of a node: what springs add to the diagonal of A [kg]
    double last;
    int count, unused;              // changes so far
    long long step[SPRING_CHANGES];  // whose matrix is the first with the new value; a ring
    double before[SPRING_CHANGES];  // the old one
};

struct CorrectedBody {              // kept from solve to solve
    long long step;                 // of the factor that V is for
    int used, usable;               // nodes of V; 1: M is that of `block`
    int node[MOST_CORRECTED];       // of the body
    double block[MOST_CORRECTED][6];  // C that M was made with, upper triangles [kg]
};

struct Correction {                 // arguments
    int capacity, width;            // most nodes of a body; numbers in a row of V and M
    int sites;                      // nodes with rows of contact
    CorrectedBody* bodies;          // (bodies,)
    const real* spring;             // (nodes,) of grabs [N/m]; null: nothing can be touched
    SpringHistory* springs;         // (nodes,)
    const int* pair;                // (nodes,) as ContactArguments has it; null: no contact
    const real* base;               // likewise
    const float* blocks_then;       // (HISTORY, sites, 6) what contacts added for a factor, upper triangles [kg]
    float* share;                   // (nodes,) size of a node's difference relative to its own block; 0: there is none
    double* difference;             // (nodes, 6) C of nodes with a share, upper triangles [kg]
    float* columns;                 // (nodes, 3, width) V
    float* inner;                   // (bodies, width, width) M
    double* scratch;                // (bodies, scratch_size(capacity)) for make_inner
    double spring_scale;            // by which a spring is multiplied on the diagonal of A [s2]
};

// Place of entry (i, j) of a symmetric block in its upper triangle.
HOST_DEVICE int upper(int i, int j) {
    const int low = i < j ? i : j, high = i < j ? j : i;
    return 3 * low - low * (low + 1) / 2 + high;
}

// Takes note of what springs add to the matrix of a step.
HOST_DEVICE void note_spring(SpringHistory& h, long long step, double now) {
    if (now == h.last) return;
    h.step[h.count % SPRING_CHANGES] = step;
    h.before[h.count % SPRING_CHANGES] = h.last;
    h.last = now;
    ++h.count;
}

// What springs add now, less what they added to the matrix of step `then`; 0 if there were too many changes.
HOST_DEVICE double spring_difference(const SpringHistory& h, long long then, double now) {
    double before = h.last;
    for (int k = h.count; k > 0; --k) {
        if (k <= h.count - SPRING_CHANGES) return 0;
        if (h.step[(k - 1) % SPRING_CHANGES] <= then) break;
        before = h.before[(k - 1) % SPRING_CHANGES];
    }
    return now - before;
}

// Difference of what a spring adds now from what it added then, within what an inverse of so many planes resolves. rest: the node's own
// entry without the spring.
HOST_DEVICE double bounded_difference(double delta, double rest, int planes) {
    const double most = STIFF[planes > 1] * ldexp(1.0, ilogb(rest));  // the same from step to step
    if (delta > most) return most;
    return delta < 0 ? (1 - REMAINS[planes > 1]) * delta : delta;
}

// Difference of a node's own block from that of the factor's matrix; returns its size relative to the block, 0 if there is none.
// pair: of the node, -1 without contacts; spring: spring_difference; own: its block of A now (9); then: step of the factor.
HOST_DEVICE double difference_of(const Correction& c, int pair, double spring, const real* own, long long then, int planes, double out[6]) {
    const double trace = ((double)own[0] + own[4] + own[8]) / 3;
    double size = 0;
    for (int k = 0; k < 6; ++k) out[k] = 0;
    const long long slot = then % HISTORY;
    for (int i = 0; i < 3 && pair >= 0; ++i)
        for (int j = i; j < 3; ++j) {
            const int k = upper(i, j);
            const double now = (double)own[3 * i + j] - (double)c.base[9ll * (pair / 2) + 3 * i + j];
            out[k] = now - (double)c.blocks_then[6 * (slot * c.sites + pair / 2) + k];
        }
    const double rest = trace - (spring > 0 ? spring : 0);
    if (spring != 0 && rest > 0) spring = bounded_difference(spring, rest, planes);
    for (int i = 0; i < 3; ++i) out[upper(i, i)] += spring;
    for (int k = 0; k < 6; ++k) size = fabs(out[k]) > size ? fabs(out[k]) : size;
    const double share = rest > 0 ? size / rest : 0;
    return share > NOTHING ? share : 0;
}
