// SPDX-License-Identifier: MIT
// Momenta of bodies that nothing holds, in a Rosenbrock-W step (method: kernels/rigid_motion.h). Only scenes have this in which a body
// has no fixed node.
//
//     keep_forces     epilogue of `second`: keeps b of the first stage, and the springs of grabs in it
//     sum_and_decide  epilogue of the end of an attempt: sums over the chunks of nodes of its thread block, then stage_decision.cu
//     set_momenta     the last launch of a step: each thread block adds the sums of its body in the order of the chunks, and moves the
//                     nodes of a chunk
//
// Sums are in double, in the order of the nodes of a chunk and then of the chunks, whatever thread block ends first.
#include "node_chunk.cuh"
#include "prepare_stage.cuh"
#include "rigid_motion.h"
#include "stage_decision.cu"

struct FreeBodies {
    StageDecision decision;
    const NodeChunk* chunks;         // (chunks,) of bodies without fixed nodes, none in two thread blocks
    const int* first_chunk;          // (thread blocks + 1,)
    MomentumSums* sums;              // (chunks,) of the last attempt of the body
    const local* rotation;           // (nodes, 3, 3)
    const real* mass;                // (nodes,) [kg]
    const real* share;               // (nodes,) theta
    const real* weight;              // (nodes,) w
    const real* spring;              // (nodes,) of grabs [N/m]; null: nothing can be touched
    const real* b;                   // (nodes, 3) of the second stage, in the frame of the node [N s]
    real* first_b;                   // (nodes, 3) of the first stage
    real* first_spring;              // (nodes,) likewise
    const real* start_x;             // (nodes, 3) at the start of the step [m]
    const real* start_v;             // (nodes, 3) [m/s]
    const real* first;               // (nodes, 3) u_1 [m/s]
    const real* x;                   // (nodes, 3) at the end of the step [m]
    real* v;                         // (nodes, 3) [m/s]
    real* predictor;                 // (nodes, 3) of the next step, as the next three [m/s]
    real* damping_velocity;
    real* inertial_increment;
    real* dv;
    double h;                        // time step [s]
};

constexpr int SUMS = sizeof(MomentumSums) / sizeof(double);

__device__ __forceinline__ int own_node() { return blockIdx.x * BLOCK_ITEMS + threadIdx.x; }

__device__ __forceinline__ bool is_open(const FreeBodies& t, int body) { return t.decision.phase[body] == OPEN; }

// First node of the body of a chunk, the origin of MomentumSums.
__device__ __forceinline__ Vector3 origin_of(const FreeBodies& t, const NodeChunk& chunk) {
    return at3(t.start_x, t.chunks[chunk.first].begin);
}

__device__ void keep_forces(const FreeBodies& t) {
    const int i = own_node();
    if (threadIdx.x >= BLOCK_ITEMS || i >= t.decision.nodes || !is_open(t, t.decision.body[i])) return;
    put3(t.first_b, i, at3(t.b, i));
    if (t.spring) t.first_spring[i] = t.spring[i];
}

// g h times the force on a node, from b and from what inertia has in it [N s], which is in the world frame. The two are subtracted in
// the frame of the node: whatever the rounding of this frame, what remains of inertia is none.
__device__ __forceinline__ Vector3 force_in(const FreeBodies& t, int i, const real* b, Vector3 inertia) {
    const local* R = t.rotation + 9ll * i;
    const Vector3 rows[3] = {at3(R, 0), at3(R, 1), at3(R, 2)};
    const Vector3 back = inertia.x * rows[0] + inertia.y * rows[1] + inertia.z * rows[2], f = at3(b, i) - back;
    return {dot3(rows[0], f), dot3(rows[1], f), dot3(rows[2], f)};
}

// Sums of one node (symbols: mechanics/rosenbrock.py).
__device__ __forceinline__ MomentumSums sums_of(const FreeBodies& t, int i, Vector3 origin) {
    MomentumSums sums = {};
    const double mass = t.mass[i], w = t.weight[i];
    const Vector3 x = at3(t.start_x, i), v = at3(t.start_v, i), u = at3(t.first, i), s = (1 / ROS2_GAMMA - 2) * u - v;
    sums.held = t.spring && (t.spring[i] != 0 || t.first_spring[i] != 0);
    add_impulse(sums, x - origin, force_in(t, i, t.first_b, mass * w * v));
    add_impulse(sums, x + t.h * (v + u) - origin, force_in(t, i, t.b, mass * (w * s - 2.0 * u)));
    add_motion(sums, mass, x - origin, v, at3(t.x, i) - origin, at3(t.v, i));
    return sums;
}

// Bodies that rest, and steps of backward Euler, are left as they are.
__device__ __forceinline__ MomentumSums left_alone() {
    MomentumSums sums = {};
    sums.held = 1;
    return sums;
}

__device__ void sum_momenta(const FreeBodies& t) {
    __shared__ MomentumSums terms[BLOCK_ITEMS];
    const int i = own_node(), begin = t.first_chunk[blockIdx.x], end = t.first_chunk[blockIdx.x + 1];
    for (int k = begin; k < end; ++k) {
        const NodeChunk chunk = t.chunks[k];
        if (threadIdx.x >= BLOCK_ITEMS || i < chunk.begin || i >= chunk.end || !is_open(t, chunk.body)) continue;
        const bool takes_part = t.decision.attempt != EULER && t.decision.end.moving[chunk.body] != 0;
        terms[threadIdx.x] = takes_part ? sums_of(t, i, origin_of(t, chunk)) : left_alone();
    }
    __syncthreads();
    for (int k = threadIdx.x; k < SUMS * (end - begin); k += blockDim.x) {
        const int number = begin + k / SUMS, column = k % SUMS;
        const NodeChunk chunk = t.chunks[number];
        if (!is_open(t, chunk.body)) continue;  // made by an earlier attempt, whose sums stay
        double sum = 0;
        for (int node = chunk.begin; node < chunk.end; ++node) sum += ((const double*)(terms + node % BLOCK_ITEMS))[column];
        ((double*)(t.sums + number))[column] = sum;
    }
}

__device__ void sum_and_decide(const FreeBodies& t) {
    sum_momenta(t);
    decide(t.decision);
}

// One thread block a chunk.
extern "C" __global__ void __launch_bounds__(BLOCK_ITEMS) set_momenta(const FreeBodies t) {
    __shared__ MomentumSums total;
    const NodeChunk chunk = t.chunks[blockIdx.x];
    for (int column = threadIdx.x; column < SUMS; column += blockDim.x) {
        double sum = 0;
#pragma unroll 8
        for (int k = 0; k < chunk.chunks; ++k) sum += ((const double*)(t.sums + chunk.first + k))[column];
        ((double*)&total)[column] = sum;
    }
    __syncthreads();
    const int i = chunk.begin + threadIdx.x;
    if (total.held != 0 || i >= chunk.end) return;
    const Vector3 v = moved(rigid_motion(total), at3(t.x, i) - origin_of(t, chunk), at3(t.v, i));
    const vec3 ended = {(real)v.x, (real)v.y, (real)v.z}, zero = {};
    store3(t.v, i, ended);
    prepare_stage(t, i, ended, zero, ended);
}
