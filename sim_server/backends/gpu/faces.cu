// SPDX-License-Identifier: MIT
// Rows of triangles against obstacles on a GPU, beside contact.cu: detection, the law, the sweep, and the end of a step. A thread block has
// a body, or each thread a triangle; nodes sum what comes of it in contact.cu (device_faces.cuh).
#ifndef FACE_ROWS
#define FACE_ROWS
#endif
#include "face_sweep.cuh"

// A thread has a triangle: sets its row, once a step.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) detect_faces(const ContactArguments c) {
    const int i = blockIdx.x * CONTACT_THREADS + threadIdx.x;
    if (i < c.faces.start[c.count] - c.faces.start[0]) detect_face(c, c.faces.body[i], c.faces.start[0] + i);
}

// --- the law ------------------------------------------------------------------------------------------------------------------------

// u = sum_a weight_a R_a v(node) of the corners that may move
template <class Of> __device__ __forceinline__ void gather_face(const ContactArguments& c, int r, double* u, Of of) {
    u[0] = u[1] = u[2] = 0;
    for (int a = 0; a < 3; ++a) {
        const int node = c.faces.node[3 * (r - c.faces.start[0]) + a];
        if (c.free[node] == 0) continue;
        const local* R = c.rotation + 9ll * node;
        const double weight = c.faces.weight[CORNERS * r + a];
        double v[3];
        of(node, v);
        for (int k = 0; k < 3; ++k) u[k] += weight * ((double)R[3 * k] * v[0] + (double)R[3 * k + 1] * v[1] + (double)R[3 * k + 2] * v[2]);
    }
}

// Displacement of a row's point, u as gathered from velocities.
__device__ __forceinline__ void displace_face(const ContactArguments& c, int r, const double* u, double* s) {
    for (int k = 0; k < 3; ++k) {
        double p = 0;
        for (int a = 0; a < 3; ++a)
            p += c.faces.weight[CORNERS * r + a] * (double)c.predictor[3ll * c.faces.node[3 * (r - c.faces.start[0]) + a] + k];
        s[k] = c.dx_dv * (p + u[k]);
    }
}

__device__ __forceinline__ void impulse_of(const ContactArguments& c, int r, double* f) {
    const ContactForce& force = c.row[r].force;
    for (int k = 0; k < 3; ++k) f[k] = c.force_coefficient * (force.normal * c.normal[3 * r + k] + force.traction[k]);
}

__device__ __forceinline__ void stiff_face(const double* k, const double* u, double* out) {
    out[0] = k[0] * u[0] + k[1] * u[1] + k[2] * u[2];
    out[1] = k[1] * u[0] + k[3] * u[1] + k[4] * u[2];
    out[2] = k[2] * u[0] + k[4] * u[1] + k[5] * u[2];
}

// f(row) of a body's triangles in use, those of a thread
template <class F> __device__ __forceinline__ void each_listed_face(const ContactArguments& c, int body, int listed, F f) {
    const int faces = c.faces.rows[body];
    const int* list = list_of(c, body) + listed - faces;
    for (int k = threadIdx.x; k < faces; k += CONTACT_THREADS) f(list[k]);
}

// Before contact_forces: a body's rows with the velocities that it will have there.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) face_forces(const ContactArguments c) {
    const int body = blockIdx.x;
    const ContactState& state = c.state[body];
    const bool starts = state.phase == CHOOSE_START;
    if (!starts && state.phase != READY) return;
    double changed[1] = {0};
    each_listed_face(c, body, state.rows, [&](int r) {
        FaceRow& own = face_row(c, r);
        double u[3] = {0, 0, 0}, s[3];
        if (starts) {
            displace_face(c, r, u, s);
            evaluate(c, r, s, false, true);
            impulse_of(c, r, own.pull);
        }
        gather_face(c, r, u, [&](int node, double* y) {
            load3(c.y, node, y);
            for (int k = 0; k < 3 && !starts && state.alpha != 1; ++k) {
                const double from = c.start[3ll * node + k];
                y[k] = (real)(from + state.alpha * (y[k] - from));
            }
        });
        displace_face(c, r, u, s);
        evaluate(c, r, s, state.hold, state.set, state.rested && state.passes == 0 && !starts);
        impulse_of(c, r, own.impulse);
        if (starts) return;
        const ContactRow row = row_at(c, r);
        contact_stiffness(row, c.row[r].force, c.row[r].dual, c.dx_dv * c.force_coefficient, own.stiffness);
        stiff_face(own.stiffness, u, own.pull);
        changed[0] += state.set && c.row[r].in_set != (int)contact_force(row, s, 0, false).closed;
    });
    sum_block(changed);
    if (threadIdx.x == 0) c.faces.counted[body] = (int)changed[0];
}

// Before contact_search: a body's rows after the solve.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) face_search(const ContactArguments c) {
    const int body = blockIdx.x;
    const ContactState& state = c.state[body];
    const int phase = state.phase;
    if (phase == OVER || phase == LOST || phase == ENDED) return;
    double acts[1] = {0};
    each_listed_face(c, body, state.rows, [&](int r) {
        FaceRow& own = face_row(c, r);
        DeviceRow& row = c.row[r];
        double u[3], s[3];
        if (phase == PASSED || phase == LAST_PASSED) {
            gather_face(c, r, u, [&](int node, double* dy) {
                double from[3];
                load3(c.y, node, dy);
                load3(c.start, node, from);
                for (int k = 0; k < 3; ++k) dy[k] -= from[k];
            });
            for (int k = 0; k < 3; ++k) row.step[k] = c.dx_dv * u[k];
            stiff_face(own.stiffness, u, own.pull);
        }
        if (phase == PASSED) return;
        for (int k = 0; k < 3 && phase == LAST_PASSED; ++k) own.pull[k] -= own.impulse[k];
        gather_face(c, r, u, [&](int node, double* y) { load3(c.y, node, y); });
        displace_face(c, r, u, s);
        evaluate(c, r, s, phase == LAST_PASSED, false);
        impulse_of(c, r, own.impulse);
        acts[0] += row.force.closed || row.force.slip > 0;
    });
    sum_block(acts);
    if (threadIdx.x == 0) c.faces.counted[body] = (int)acts[0];
}

// A thread has a triangle, after face_search: rows where the solution takes it into obstacles.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) sweep_faces(const ContactArguments c) {
    const int i = blockIdx.x * CONTACT_THREADS + threadIdx.x;
    if (i >= c.faces.start[c.count] - c.faces.start[0]) return;
    const int body = c.faces.body[i], phase = c.state[body].phase;
    if (phase != SOLVED && phase != LAST_PASSED && phase != ENDED) return;
    if (phase != SOLVED && is_held_back(c, c.state[body])) return;
    if (sweep_face(c, body, c.faces.start[0] + i)) c.faces.entered[body] = 1;
}

// --- the end of a step --------------------------------------------------------------------------------------------------------------

// Notes which triangles of a body y takes into obstacles. Returns whether there are such. Done by a whole thread block.
__device__ bool note_passages(const ContactArguments& c, int body) {
    const FaceTables t = face_tables(c);
    const FaceMotion m = face_motion(c, true);
    bool found = false;
    for (int r = c.faces.start[body] + threadIdx.x; r < c.faces.start[body + 1]; r += CONTACT_THREADS) {
        FaceRow& own = face_row(c, r);
        FaceWays ways(c, m, r);
        own.held_at = -1;
        for (int o = 0; o < c.obstacle_count; ++o) {
            double time;
            if (!ways.past(c, o, 0) || passage_of_face(t, r, o, ways.ways, &time).obstacle < 0) continue;
            own.held_at = o;
            own.time = time;
            found = true;
        }
    }
    return !__syncthreads_and(!found);
}

// Sets a node of such triangles back: of several the last one, by obstacle, then by number.
__device__ void hold_node(const ContactArguments& c, const SurfaceNode& n) {
    int last = -1, obstacle = -1;
    for (int e = c.faces.entry_start[n.node]; e < c.faces.entry_start[n.node + 1]; ++e) {
        const int face = c.faces.entry[e] / CORNERS, at = c.faces.row[face].held_at;
        if (at < 0 || at < obstacle) continue;
        obstacle = at;
        last = face;
    }
    if (last < 0) return;
    double y[3], from[3], to[3], back[3];
    load3(c.y, n.node, y);
    load3(c.x, n.node, from);
    n.displacement(c, y, to);
    for (int k = 0; k < 3; ++k) to[k] += from[k];
    const double time = c.faces.row[last].time;
    place_before(c.obstacles, c.obstacle_count, obstacle, way_of(c.obstacles, obstacle, from, to), time, from, back, entry_of(c));
    put_at(c, n, from, back);
}

// Calls f with each node of a body that takes part in contact and is the calling thread's. No lambda with `auto`: some versions of NVRTC take one
// for a function of the host.
template <class F> __device__ __forceinline__ void each_own_node(const ContactArguments& c, int body, F f) {
    for (int i = c.faces.node_start[body] + threadIdx.x; i < c.faces.node_start[body + 1]; i += CONTACT_THREADS)
        if (const SurfaceNode n = SurfaceNode::at(c, i); n.pair >= 0) f(n);
}

// Sets what y still takes into obstacles back; returns the number of nodes that are moved. Done by a whole thread block, whose threads have
// nodes of their own.
__device__ int hold_body(const ContactArguments& c, int body) {
    each_own_node(c, body, [&](const SurfaceNode& n) {
        for (long long k = 3ll * n.node; k < 3ll * n.node + 3; ++k) c.start[k] = c.y[k];
    });
    for (int round = 0;; ++round) {
        each_own_node(c, body, [&](const SurfaceNode& n) { clip(c, n); });
        __syncthreads();
        if (round == HOLDS || !note_passages(c, body)) break;
        each_own_node(c, body, [&](const SurfaceNode& n) { hold_node(c, n); });
    }
    double moved[1] = {0};
    each_own_node(c, body, [&](const SurfaceNode& n) {
        const real *y = c.y + 3ll * n.node, *before = c.start + 3ll * n.node;
        moved[0] += y[0] != before[0] || y[1] != before[1] || y[2] != before[2];
    });
    sum_block(moved);
    return (int)moved[0];
}

// Before finish_contact: holds a body back, and keeps the forces of its triangles for the next step.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) finish_faces(const ContactArguments c) {
    const int body = blockIdx.x;
    const bool well = c.results[(c.step[0] % c.capacity) * c.count + body].status != NOT_FINITE;
    const int held = well && is_held_back(c, c.state[body]) ? hold_body(c, body) : 0;
    double sum[2] = {0, 0};
    for (int r = c.faces.start[body] + threadIdx.x; r < c.faces.start[body + 1]; r += CONTACT_THREADS) {
        if (!used(c, r)) continue;
        const DeviceRow& row = c.row[r];
        const bool closed = well && row.force.normal > 0;
        const double before = c.force[r];
        double f[3], u[3], s[3];
        c.force[r] = closed ? row.force.normal : 0;
        c.hardening[r] = lasting_hardening(c.hardening[r], before, c.force[r], c.stiffness[r], c.thickness[r]);
        for (int k = 0; k < 3; ++k) {
            c.traction[3 * r + k] = closed ? row.force.traction[k] : 0;
            f[k] = c.force[r] * c.normal[3 * r + k] + c.traction[3 * r + k];
        }
        if (!closed) continue;
        gather_face(c, r, u, [&](int node, double* y) { load3(c.y, node, y); });
        displace_face(c, r, u, s);
        sum[0] += 1;
        sum[1] += dot3(f, s);
    }
    sum_block(sum);
    if (threadIdx.x > 0) return;
    c.faces.sums[2 * body] = sum[0];
    c.faces.sums[2 * body + 1] = sum[1];
    c.faces.clipped[body] = held;
}
