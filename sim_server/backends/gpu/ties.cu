// SPDX-License-Identifier: MIT
// Attachments and springs on a GPU: the start and the end of a step (law: kernels/ties.cuh; order: island_state.cuh). Their rows are
// solved in islands (island.cu).
#include "island_state.cuh"

// Tells what a node is attached to, and takes its rows with that away.
__device__ void bind(const IslandArguments& a, int k) {
    const int node = a.bound_node[k];
    const int site = bodies_touch(a) ? a.t.node_site[node] : -1;
    int bound = 0;
    for (int e = a.bound_start[k]; e < a.bound_start[k + 1]; ++e) {
        const int other = a.bound_other[e];
        if (a.ties.broken[a.bound_tie[e]]) continue;
        bound = other + 1;
        for (int row = a.t.pair_first + 2 * site; site >= 0 && row < a.t.pair_first + 2 * site + 2; ++row)
            if (a.t.obstacle[row] == other) a.t.obstacle[row] = -1;
    }
    a.ties.bound[node] = bound;
}

// After detection. A thread has a node that may be bound, and a tie: sets its law for the step.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) begin_ties(const IslandArguments a) {
    const int i = blockIdx.x * CONTACT_THREADS + threadIdx.x;
    if (i < a.bound_nodes) bind(a, i);
    if (i >= a.ties.count) return;
    a.t.obstacle[a.ties.first + i] = other_of_tie(a.ties, i);
    if (a.ties.broken[i]) return;
    if (a.ties.stiffness[i] == 0) {
        auto block_of = [&](int node) { return a.c.values + 9ll * a.c.place[node]; };
        const double scale = a.c.dx_dv * a.c.force_coefficient;
        a.ties.stiffness[i] = a.ties.kappa[i] / compliance_of_tie(a.ties, a.t.corner, a.t.weight, a.c.free, scale, i, block_of);
    }
    double e[3];
    gap_of_tie(a.ties, a.c.obstacles, a.t.corner, a.t.weight, a.c.x, i, e);
    set_tie(a.ties, i, e);
}

// A thread has an edge: takes its rows with what its nodes, or those of the other edge, are attached to away.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) bind_edges(const IslandArguments a) {
    const int edge = blockIdx.x * CONTACT_THREADS + threadIdx.x;
    if (edge >= a.edges) return;
    for (int row = a.e.start[0] + 2 * edge; row < a.e.start[0] + 2 * edge + 2; ++row) {
        const int other = a.t.obstacle[row], *node = a.t.corner + CORNERS * row;
        if (other >= 0 && are_bound(a, node, a.edge_body[edge], node + 2, other)) a.t.obstacle[row] = -1;
    }
}

// First corner at the end of the step.
__device__ void first_point(const IslandArguments& a, int i, double* p) {
    const int node = a.t.corner[CORNERS * (a.ties.first + i)];
    double y[3], u[3];
    load3(a.c.x, node, p);
    load3(a.c.y, node, y);
    rotated(rotation_of(a, node), y, u);
    for (int k = 0; k < 3; ++k) p[k] += a.c.dx_dv * ((double)a.c.predictor[3ll * node + k] + u[k]);
}

// A thread block has an attachment or a spring: keeps the forces of its ties, breaks those that are too much, and sums what its bodies
// exert. After all that moves nodes. Torques are about the mean of its first points at the end of the step.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) keep_ties(const IslandArguments a) {
    const Ties& t = a.ties;
    const int first = a.table_start[blockIdx.x], last = a.table_start[blockIdx.x + 1];
    double middle[3] = {}, sum[6] = {}, p[3];
    for (int k = first + threadIdx.x; k < last; k += CONTACT_THREADS) {
        first_point(a, t.order[k], p);
        for (int m = 0; m < 3; ++m) middle[m] += p[m];
    }
    sum_block(middle);
    const int body = t.body[2 * t.order[first]], other = joins_bodies(t, t.order[first]) ? t.body[2 * t.order[first] + 1] : -1;
    const bool well = a.c.results[(a.c.step[0] % a.c.capacity) * a.bodies_count + body].status != NOT_FINITE;
    for (int k = first + threadIdx.x; k < last; k += CONTACT_THREADS) {
        const int i = t.order[k];
        const bool acts = well && a.t.obstacle[t.first + i] >= 0;
        const double* f = a.c.row[t.first + i].force.traction;
        keep_tie(t, i, acts, f, a.c.step[0] + 1);
        a.broken_on_host[i] = t.broken[i];
        if (!acts) continue;
        first_point(a, i, p);
        for (int m = 0; m < 3; ++m) p[m] -= middle[m] / (last - first);
        add_reaction_of_tie(f, p, sum);
    }
    sum_block(sum);
    if (threadIdx.x > 0) return;
    auto reaction = [&](int b) { return t.reaction + 6 * ((long long)t.columns * b + t.column_first + t.table[t.order[first]]); };
    for (int k = 0; k < 6; ++k) {
        reaction(body)[k] = sum[k];
        if (other >= 0) reaction(other)[k] = -sum[k];
    }
}
