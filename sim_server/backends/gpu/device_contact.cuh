// SPDX-License-Identifier: MIT
// Rows of contact on a GPU: arguments of the kernels, sums, what acts at a node, and points that enter obstacles; shared by contact.cu
// and island.cu.
//
// Rows against obstacles come in pairs, of one node each with weight 1, and, with FACE_ROWS, one for each triangle of a surface
// (device_faces.cuh). Numbers of contact are double for every `real`.
#pragma once
#include "contact_state.cuh"
#include "correction_state.cuh"
#include "energy_balance.cuh"
#include "node_chunk.cuh"

#ifndef local
#define local real
#endif

constexpr int CONTACT_THREADS = 128, CONTACT_SUMS = 6;
#define WARP 0xffffffffu
#ifdef FACE_ROWS
constexpr bool FACES = true;
#else
constexpr bool FACES = false;
#endif

struct DeviceRow {       // of a row in the step under way
    double s[3];         // displacement of its point by the velocities reached [m]
    double step[3];      // by the solution of the pass [m]
    double limit;        // normal force that limits friction, held in a pass [N]
    double dual[3];      // friction force with which the pass linearizes friction [N]
    ContactForce force;
    int in_set;          // 1: counts as closed in the first pass
};

struct FaceRow {         // of a triangle in the step under way
    double stiffness[6];  // upper triangle of the force's slope times h^2, world frame [kg]
    double impulse[3];    // i (lambda n + tau)
    double pull[3];       // what nodes sum next, by what contact_search or contact_forces does
    double time;          // of the passage through `held_at`
    int held_at;          // obstacle that it is set back in front of; -1: none
};

struct DeviceFaces {     // triangles with rows against obstacles; null where there are none
    const int* start;           // (bodies + 1,) rows
    const int* node;            // (faces, 3)
    const int* owns;            // (faces,) bits
    const int* body;            // (faces,)
    const double* friction;     // (bodies, obstacles)
    const int* node_site;       // (nodes,) or -1
    const int* node_start;      // (bodies + 1,) nodes
    const double* gravity;      // (3,) [m/s2]
    const int* entry_start;     // (nodes + 1,)
    const int* entry;           // CORNERS * triangle + corner, those of a node ascending
    const int* entry_link;      // (entries, 2) links from the corner to the next one, and to the one after; -1: there is none
    const int* link_start;      // (nodes + 1,)
    const int* link_place;      // (links,) of the block between a node and another one on the surface, in values
    int* corner;                // (rows, CORNERS)
    double* weight;             // (rows, CORNERS)
    int* dropped;               // (sites,)
    real* base;                 // (links, 3, 3) blocks without contact
    real* known;                // (links, 3, 3) and as a factor is to know them
    FaceRow* row;               // (faces,)
    int* rows;                  // (bodies,) in use, the last of those that are listed
    int* counted;               // (bodies,) rows that act, or that do not count as closed as the law has it
    int* entered;               // (bodies,) 1: the solution takes a triangle into an obstacle
    int* clipped;               // (bodies,) nodes held back before the others are
    double* sums;               // (bodies, 2) rows that carry force, and their work
};

struct ContactArguments {
    ObstacleTable obstacles;
    const int* body_start;      // (bodies + 1,) rows
    int* obstacle;              // (rows,)
    double* normal;             // (rows, 3)
    double* gap;                // (rows,)
    double* drift;              // (rows, 3)
    double* entry;              // (rows,)
    const double* stiffness;    // (rows,)
    const double* friction;     // (rows,)
    const double* thickness;    // (rows,)
    double* hardening;          // (rows,)
    double* force;              // (rows,)
    double* traction;           // (rows, 3)
    const int* pair;            // (nodes,) first row of the node, -1: none
    const int* node;            // (rows,)
    const int* place;           // (nodes,) of the node's own block in values
    const real* x;              // (nodes, 3) at the start of the step [m]
    const real* predictor;      // (nodes, 3) [m/s]
    const real* free;           // (nodes,) 1, or 0 at fixed nodes
    const local* rotation;      // (nodes, 3, 3)
    const real* b;              // (nodes, 3) material frame, without contact
    real* contact_b;            // (nodes, 3) b' of the solver
    real* y;                    // (nodes, 3)
    real* start;                // (nodes, 3) y before the pass
    const real* first;          // (nodes, 3) residual before the pass
    const real* last;           // (nodes, 3) and after it; -A y where a start is chosen
    real* values;               // (blocks, 3, 3)
    real* base;                 // (rows / 2, 3, 3) own blocks without contact
    real* known;                // (rows / 2, 3, 3) and as a factor is to know them
    DeviceRow* row;             // (rows,)
    int* list;                  // (rows,) those of a body that are not empty, from its first row on
    ContactState* state;        // (bodies,)
    int* active;                // (1,) bodies that are not OVER
    const NodeChunk* chunks;    // (grid,)
    double* partial_sums;       // (grid, CONTACT_SUMS)
    unsigned* finished_chunks;  // (bodies,) zero between launches
    unsigned* pool_counter;     // (1,) of the solver
    PcgResult* results;         // (capacity, bodies)
    const long long* step;      // (1,) completed
    Balance* balance;           // (bodies,)
    ContactResult* contact_results;  // (capacity, bodies) on the host
    double* reactions;          // (capacity, bodies, obstacles, 6) on the host
    const int* island_of;       // (bodies,) -1: the body is alone (island_state.cuh); null: there are no islands
    const int* alone;           // (1,) how many are
    double* pair_sums;          // (grid,) work of rows between bodies
    int* pair_contacts;         // (bodies,) those that carry force
    const real* spring;         // (nodes,) as Correction has it
    SpringHistory* springs;     // (nodes,) likewise
    float* blocks_then;         // (HISTORY, rows / 2, 6) likewise; null: factors are not corrected for contacts
    double spring_scale;        // likewise
    double dx_dv;               // [s]
    double force_coefficient;   // [s]
    double tolerance;
    int obstacle_count, count, capacity, passes;
    int* pair_clipped;          // (bodies,) places where it is held apart from others
    DeviceFaces faces;
};

// --- sums ---------------------------------------------------------------------------------------------------------------------------

// Sums over the thread block, in all of its threads.
template <int THREADS_OF_BLOCK = CONTACT_THREADS, int N> __device__ void sum_block(double (&sum)[N]) {
    __shared__ double warps[THREADS_OF_BLOCK / 32][N];
    for (int k = 16; k; k >>= 1)
        for (int n = 0; n < N; ++n) sum[n] += __shfl_xor_sync(WARP, sum[n], k);
    __syncthreads();  // earlier contents have been read
    if (threadIdx.x % 32 == 0)
        for (int n = 0; n < N; ++n) warps[threadIdx.x / 32][n] = sum[n];
    __syncthreads();
    for (int n = 0; n < N; ++n) {
        sum[n] = 0;
        for (int k = 0; k < THREADS_OF_BLOCK / 32; ++k) sum[n] += warps[k][n];
    }
}

// Sums over a body; true in the thread block that finishes last, all of whose threads have them.
__device__ bool sum_body(const ContactArguments& c, const NodeChunk& here, double (&sum)[CONTACT_SUMS]) {
    __shared__ bool last;
    sum_block(sum);
    if (here.chunks == 1) return true;
    if (threadIdx.x == 0) {
        for (int n = 0; n < CONTACT_SUMS; ++n) __stcg(c.partial_sums + CONTACT_SUMS * blockIdx.x + n, sum[n]);
        __threadfence();
        last = atomicAdd(c.finished_chunks + here.body, 1u) == here.chunks - 1u;
    }
    __syncthreads();
    if (!last) return false;
    __threadfence();
    for (int n = 0; n < CONTACT_SUMS; ++n) sum[n] = 0;
    for (int k = threadIdx.x; k < here.chunks; k += CONTACT_THREADS)
        for (int n = 0; n < CONTACT_SUMS; ++n) sum[n] += __ldcg(c.partial_sums + CONTACT_SUMS * (here.first + k) + n);
    sum_block(sum);
    if (threadIdx.x == 0) c.finished_chunks[here.body] = 0;
    return true;
}

// An entry of sums, without an index that the compiler does not know.
template <int N> __device__ __forceinline__ double pick(const double (&sum)[N], int k) {
    double found = 0;
    for (int n = 0; n < N; ++n) found = n == k ? sum[n] : found;
    return found;
}

// --- rows ---------------------------------------------------------------------------------------------------------------------------

__device__ __forceinline__ bool used(const ContactArguments& c, int row) { return __ldcg(c.obstacle + row) >= 0; }

// Where the list of a body's rows begins.
__device__ __forceinline__ int* list_of(const ContactArguments& c, int body) {
    return c.list + c.body_start[body] + (FACES ? c.faces.start[body] - c.faces.start[0] : 0);
}

// Lists the rows from first to last that are not empty, in order; returns their number. Done by a whole thread block.
__device__ __forceinline__ int list_range(const ContactArguments& c, int first, int last, int* list) {
    __shared__ int before[CONTACT_THREADS];
    const int each = (last - first + CONTACT_THREADS - 1) / CONTACT_THREADS;
    const int begin = min(first + (int)threadIdx.x * each, last), end = min(begin + each, last);
    int own = 0;
    for (int r = begin; r < end; ++r) own += used(c, r);
    __syncthreads();
    before[threadIdx.x] = own;
    __syncthreads();
    for (int by = 1; by < CONTACT_THREADS; by *= 2) {
        const int other = (int)threadIdx.x >= by ? before[threadIdx.x - by] : 0;
        __syncthreads();
        before[threadIdx.x] += other;
        __syncthreads();
    }
    int* to = list + before[threadIdx.x] - own;
    for (int r = begin; r < end; ++r)
        if (used(c, r)) *to++ = r;
    return before[CONTACT_THREADS - 1];
}

// Lists the rows of a body that are not empty, those of triangles last; returns their number. Done by a whole thread block.
__device__ int list_rows(const ContactArguments& c, int body) {
    const int nodes = list_range(c, c.body_start[body], c.body_start[body + 1], list_of(c, body));
    if (!FACES) return nodes;
    __syncthreads();
    const int faces = list_range(c, c.faces.start[body], c.faces.start[body + 1], list_of(c, body) + nodes);
    if (threadIdx.x == 0) c.faces.rows[body] = faces;
    return nodes + faces;
}

__device__ __forceinline__ ContactRow row_at(const ContactArguments& c, int r) {
    return {c.normal + 3 * r, c.drift + 3 * r, c.traction + 3 * r, c.gap[r], c.thickness[r], c.hardening[r] * c.stiffness[r], c.friction[r]};
}

struct SurfaceNode {         // a node and its frame
    int node, pair;
    double R[9];

    // Of node i; pair < 0: it has no rows, or cannot move.
    __device__ __forceinline__ static SurfaceNode at(const ContactArguments& c, int i) {
        SurfaceNode n = {i, c.pair[i], {}};
        if (n.pair >= 0 && c.free[i] == 0) n.pair = -1;
        if (n.pair >= 0)
            for (int k = 0; k < 9; ++k) n.R[k] = c.rotation[9ll * i + k];
        return n;
    }
    __device__ __forceinline__ void to_world(const double* v, double* out) const {
        for (int k = 0; k < 3; ++k) out[k] = R[3 * k] * v[0] + R[3 * k + 1] * v[1] + R[3 * k + 2] * v[2];
    }
    __device__ __forceinline__ void to_material(const double* v, double* out) const {
        for (int k = 0; k < 3; ++k) out[k] = R[k] * v[0] + R[3 + k] * v[1] + R[6 + k] * v[2];
    }
    // Displacement in the step by velocities y.
    __device__ __forceinline__ void displacement(const ContactArguments& c, const double* y, double* s) const {
        double u[3];
        to_world(y, u);
        for (int k = 0; k < 3; ++k) s[k] = c.dx_dv * ((double)c.predictor[3ll * node + k] + u[k]);
    }
    // f += i R^T (lambda n + tau)
    __device__ __forceinline__ void add_force(const ContactArguments& c, int r, const ContactForce& force, double* f) const {
        double w[3], m[3];
        for (int k = 0; k < 3; ++k) w[k] = c.force_coefficient * (force.normal * c.normal[3 * r + k] + force.traction[k]);
        to_material(w, m);
        for (int k = 0; k < 3; ++k) f[k] += m[k];
    }
    // S += i c R^T (-d force / ds) R
    __device__ __forceinline__ void add_stiffness(const ContactArguments& c, const ContactRow& row, const ContactForce& force, const double* dual,
                                                  double* S) const {
        double k[6];
        contact_stiffness(row, force, dual, c.dx_dv * c.force_coefficient, k);
        const double full[9] = {k[0], k[1], k[2], k[1], k[3], k[4], k[2], k[4], k[5]};
        for (int j = 0; j < 3; ++j) {
            double column[3];
            for (int m = 0; m < 3; ++m) column[m] = full[3 * m] * R[j] + full[3 * m + 1] * R[3 + j] + full[3 * m + 2] * R[6 + j];
            for (int m = 0; m < 3; ++m) S[3 * m + j] += R[m] * column[0] + R[3 + m] * column[1] + R[6 + m] * column[2];
        }
    }
};

#include "device_faces.cuh"

__device__ __forceinline__ void load3(const real* from, int i, double* to) {
    for (int k = 0; k < 3; ++k) to[k] = from[3ll * i + k];
}

// Forces of an earlier evaluation, and their stiffness: S += i c R^T S R, f += i R^T f.
__device__ __forceinline__ void add_rows(const ContactArguments& c, const SurfaceNode& n, double* f, double* S) {
    for (int r = n.pair; r < n.pair + 2; ++r) {
        if (!used(c, r)) continue;
        const DeviceRow& row = c.row[r];
        n.add_force(c, r, row.force, f);
        n.add_stiffness(c, row_at(c, r), row.force, row.dual, S);
    }
}

// Takes up what limits friction at the start of a step.
__device__ __forceinline__ void begin_friction(const ContactArguments& c, int r) {
    DeviceRow& row = c.row[r];
    row.limit = c.force[r];
    for (int k = 0; k < 3; ++k) row.dual[k] = c.traction[3 * r + k];
    bound_dual(row_at(c, r), row.limit, row.dual);
}

// Evaluates the law at displacement s. hold: there was a pass; the normal force there limits friction from now on, where the row
// counted as closed. exactly: friction is linearized by its derivative.
__device__ __forceinline__ void evaluate(const ContactArguments& c, int r, const double* s, bool hold, bool set, bool exactly = false) {
    DeviceRow& row = c.row[r];
    const ContactRow given = row_at(c, r);
    if (hold) {
        const double step[3] = {s[0] - row.s[0], s[1] - row.s[1], s[2] - row.s[2]};
        move_dual(given, row.force, step, row.dual);
        row.limit = row.force.closed ? contact_force(given, s, 0, false).normal : 0;
        bound_dual(given, row.limit, row.dual);
    }
    for (int k = 0; k < 3; ++k) row.s[k] = s[k];
    row.force = contact_force(given, s, row.limit, set && row.in_set);
    for (int k = 0; k < 3 && exactly; ++k) row.dual[k] = row.force.traction[k];
}

// Keeps a node's own block without contact, and with contacts that carried force in the last step: a factor that is made from a copy
// of A is to know them.
__device__ void keep_block(const ContactArguments& c, const SurfaceNode& n, int body) {
    const int pair = c.pair[n.node];
    if (pair < 0) return;
    double S[9] = {};
    for (int r = n.pair; n.pair >= 0 && r < n.pair + 2; ++r) {
        if (!used(c, r) || !(c.force[r] > 0)) continue;
        const ContactForce f = lasting_contact(c.friction[r], c.force[r], c.traction + 3 * r);
        n.add_stiffness(c, row_at(c, r), f, f.traction, S);
    }
    if (FACES) {
        keep_links(c, n);
        if (has_faces(c, n, body)) add_known_faces(c, n, S);
    }
    const real* own = c.values + 9ll * c.place[n.node];
    for (int k = 0; k < 9; ++k) {
        const long long to = 9ll * (pair / 2) + k;
        c.base[to] = own[k];
        c.known[to] = (real)((double)own[k] + S[k]);
    }
}

// --- points that enter obstacles ----------------------------------------------------------------------------------------------------

// Not inlined: the shapes are a large text.
__device__ __noinline__ double entry(const ObstacleTable t, int obstacle, double inflate, const double* from, const double* to, double* begin,
                                     double* end) {
    return entry_of_way(t, obstacle, inflate, from, to, begin, end);
}

// Gives an obstacle one of the rows of a pair: its own, an empty one, or the one that carries less.
__device__ void take_row(const ContactArguments& c, int pair, int obstacle, const double* from, const double* begin, const double* end,
                         double time) {
    int r = pair;
    if (c.obstacle[pair] != obstacle) {
        const bool other = c.obstacle[pair + 1] == obstacle || !used(c, pair + 1);
        r += other || (used(c, pair) && c.row[pair + 1].force.normal < c.row[pair].force.normal);
    }
    const bool same = c.obstacle[r] == obstacle;
    double *n = c.normal + 3 * r, normal[3] = {n[0], n[1], n[2]}, gap = c.gap[r];
    c.gap[r] = plane_on_way(c.obstacles, obstacle, from, begin, end, time, n, c.drift + 3 * r);
    c.obstacle[r] = obstacle;
    c.entry[r] = time;
    DeviceRow& row = c.row[r];
    if (same && dot3(normal, n) > SAME_PLANE && fabs(gap - c.gap[r]) < 0.1 * c.thickness[r]) {
        c.hardening[r] = HARDER * c.hardening[r] < HARDEST ? HARDER * c.hardening[r] : HARDEST;
        return;
    }
    row.limit = row.dual[0] = row.dual[1] = row.dual[2] = 0;
    c.hardening[r] = 1;
    row.in_set = 0;
    row.force = {0, {0, 0, 0}, 0, false};
    for (int k = 0; k < 3; ++k) c.traction[3 * r + k] = 0;
}

// Gives a point that y moves into obstacles rows there. Returns whether it enters any.
__device__ bool sweep(const ContactArguments& c, const SurfaceNode& n, const double* y) {
    bool found = false;
    double from[3], to[3], begin[3], end[3];
    load3(c.x, n.node, from);
    n.displacement(c, y, to);
    for (int k = 0; k < 3; ++k) to[k] += from[k];
    for (int o = 0; o < c.obstacle_count; ++o) {
        if (entry(c.obstacles, o, 0, from, to, begin, end) > 1) continue;
        const double near = entry(c.obstacles, o, c.thickness[n.pair], from, to, begin, end);
        take_row(c, n.pair, o, from, begin, end, near <= 1 ? near : 0);
        found = true;
    }
    return found;
}

// True if what y still takes into obstacles is held back, of a body whose solves are over.
__device__ __forceinline__ bool is_held_back(const ContactArguments& c, const ContactState& state) {
    return !gives_rows(state.rounds, state.passes, c.passes);
}

// Of first_entered.
__device__ __forceinline__ auto entry_of(const ContactArguments& c) {
    return [&t = c.obstacles](int obstacle, const double* from, const double* to, double* begin, double* end) {
        return entry(t, obstacle, 0, from, to, begin, end);
    };
}

// Moves a point to a place at the end of the step.
__device__ __forceinline__ void put_at(const ContactArguments& c, const SurfaceNode& n, const double* from, const double* to) {
    double dv[3], y[3];
    for (int k = 0; k < 3; ++k) dv[k] = (to[k] - from[k]) / c.dx_dv - (double)c.predictor[3ll * n.node + k];
    n.to_material(dv, y);
    for (int k = 0; k < 3; ++k) c.y[3ll * n.node + k] = (real)y[k];
}

// Sets a point that y moves into an obstacle back, to a part of the way. Returns whether it does.
__device__ bool clip(const ContactArguments& c, const SurfaceNode& n) {
    double y[3], from[3], to[3], back[3];
    load3(c.y, n.node, y);
    load3(c.x, n.node, from);
    n.displacement(c, y, to);
    for (int k = 0; k < 3; ++k) to[k] += from[k];
    if (!place_in_front(c.obstacles, c.obstacle_count, from, to, back, entry_of(c))) return false;
    put_at(c, n, from, back);
    return true;
}
