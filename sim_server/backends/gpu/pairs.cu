// SPDX-License-Identifier: MIT
// Where bodies touch each other on a GPU: detection (kernels/pair_detection.cuh), the sweep of the paths found, which bodies are solved
// together, and what acts at each node (order: island_state.cuh).
#include "island_state.cuh"

__device__ __forceinline__ Motion motion_of(const IslandArguments& a, bool solved) {
    return {a.c.x, a.c.predictor, solved ? a.c.y : nullptr, a.c.rotation, a.c.free, a.c.dx_dv, a.c.force_coefficient, a.gravity};
}
// That of the solution, as pair_boxes has left it.
__device__ __forceinline__ Motion way_of_step(const IslandArguments& a) {
    return {a.c.x, a.ways, nullptr, a.c.rotation, a.c.free, a.c.dx_dv, 0, a.none};
}
__device__ __forceinline__ int edges_before(const IslandArguments& a, int body) { return (a.e.start[body] - a.e.start[0]) / 2; }
// Whether the sweeps are over: what still passes through a body is held apart.
__device__ __forceinline__ bool holds_apart(const IslandArguments& a) { return __ldcg(&a.tally->rounds) >= ROUNDS; }
// True if a body's box meets another's.
__device__ __forceinline__ bool meets_others(const IslandArguments& a, int body) { return HAS_OWN ? a.near[body] & 1 : a.near[body]; }
__device__ __forceinline__ bool is_lost(const IslandArguments& a, int body) {
    return a.c.results[(a.c.step[0] % a.c.capacity) * a.bodies_count + body].status == NOT_FINITE;
}

// --- detection ----------------------------------------------------------------------------------------------------------------------

// A thread block has a body: its box, along paths under gravity alone, or as solved.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) pair_boxes(const IslandArguments a, int solved) {
    __shared__ Box warps[CONTACT_THREADS / 32];
    const int body = blockIdx.x;
    const Motion m = motion_of(a, solved);
    const double margin = thickness_of(a.t, body);
    Box box = empty_box();
    for (int site = sites_before(a.t, body) + threadIdx.x; site < sites_before(a.t, body + 1); site += CONTACT_THREADS)
        box = joined(box, box_of(m, node_of_site(a.t, site), margin));
    for (int k = a.t.tree_start[body] + threadIdx.x; k < a.t.tree_start[body + 1]; k += CONTACT_THREADS)
        for (int v = 0; v < 3 && a.t.tree_child[2 * k] < 0; ++v) {
            const int node = a.t.triangle[3 * ~a.t.tree_child[2 * k] + v];
            if (a.t.node_site[node] < 0) box = joined(box, box_of(m, node, margin));  // a fixed node
        }
    for (int by = 16; by; by >>= 1)
        for (int k = 0; k < 3; ++k) {
            box.low[k] = fmin(box.low[k], __shfl_xor_sync(WARP, box.low[k], by));
            box.high[k] = fmax(box.high[k], __shfl_xor_sync(WARP, box.high[k], by));
        }
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = box;
    __syncthreads();
    for (int w = 0; w < CONTACT_THREADS / 32; ++w) box = joined(box, warps[w]);
    if (threadIdx.x == 0) {
        a.t.body_box[body] = box;
        a.touched[body] = 0;
        if (body == 0) a.tally->found = 0;
    }
    const PcgBody& nodes = a.bodies[body];
    for (int i = nodes.first + threadIdx.x; solved && i < nodes.first + nodes.nodes; i += CONTACT_THREADS) {
        double s[3];
        displacement_of(m, i, s);
        for (int k = 0; k < 3; ++k) {
            a.ends[3ll * i + k] = (real)((double)a.c.x[3ll * i + k] + s[k]);
            a.ways[3ll * i + k] = (real)(s[k] / a.c.dx_dv);
        }
    }
}

// A thread block has a body: whether its box meets another's, and then the boxes of its tree, and its edges.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) pair_trees(const IslandArguments a, int solved) {
    const int body = blockIdx.x;
    bool apart = true;
    for (int other = threadIdx.x; is_between(a) && other < a.bodies_count; other += CONTACT_THREADS)
        if (other != body && meet(a.t.body_box[body], a.t.body_box[other])) apart = false;
    apart = __syncthreads_and(apart);
    if (threadIdx.x == 0) a.near[body] = HAS_OWN ? !apart | MAY_TOUCH_ITSELF : !apart;
    if (apart && !HAS_OWN) return;
    const Motion m = motion_of(a, solved);
    for (int height = 0; height <= a.highest_tree; ++height) {
        for (int k = a.t.tree_start[body] + threadIdx.x; k < a.t.tree_start[body + 1]; k += CONTACT_THREADS)
            if (a.tree_height[k] == height) fit_box(a.t, m, body, k);
        __syncthreads();
    }
    for (int edge = edges_before(a, body) + threadIdx.x; edge < edges_before(a, body + 1); edge += CONTACT_THREADS) fit_wings(a.e, m, edge);
}

// --- a vertex and a body ------------------------------------------------------------------------------------------------------------

constexpr int QUEUE = 64;  // triangles of a warp that wait to be looked at

// Copies what a lane has found to all lanes of the warp.
__device__ __forceinline__ void share(Meeting& m, int lane) {
    m.other = __shfl_sync(WARP, m.other, lane);
    m.triangle = __shfl_sync(WARP, m.triangle, lane);
    m.touch.entry = __shfl_sync(WARP, m.touch.entry, lane);
    m.touch.distance = __shfl_sync(WARP, m.touch.distance, lane);
    m.touch.certainty = __shfl_sync(WARP, m.touch.certainty, lane);
    for (int k = 0; k < 3; ++k) {
        m.touch.normal[k] = __shfl_sync(WARP, m.touch.normal[k], lane);
        m.touch.weight[k] = __shfl_sync(WARP, m.touch.weight[k], lane);
    }
}
__device__ __forceinline__ double least_of(double v) {
    for (int by = 16; by; by >>= 1) v = fmin(v, __shfl_xor_sync(WARP, v, by));
    return v;
}
__device__ __forceinline__ int lane_with(bool candidate, int number) {  // the lowest number among candidates; its lane
    int best = candidate ? number : 0x7fffffff;
    for (int by = 16; by; by >>= 1) best = min(best, __shfl_xor_sync(WARP, best, by));
    const unsigned holders = __ballot_sync(WARP, candidate && number == best);
    return holders ? __ffs(holders) - 1 : 0;
}

// Of what the lanes have found: the nearest, of those equally near the surest; of the others that the vertex is over, the nearest; the
// first; of equal ones the lowest triangle.
__device__ void agree(TouchSearch<Motion>& search) {
    Meeting &nearest = search.nearest, &first = search.first, &beside = search.beside;
    const Meeting own = nearest;
    bool mine = nearest.other >= 0;
    const double least = least_of(mine ? fabs(nearest.touch.distance) : 1e300);
    mine = mine && fabs(nearest.touch.distance) - least <= 1e-9 * search.thickness;
    const double surest = -least_of(mine ? -nearest.touch.certainty : 1e300);
    mine = mine && nearest.touch.certainty == surest;
    share(nearest, lane_with(mine, nearest.triangle));
    const bool nearer = beside.other < 0 || own.touch.distance < beside.touch.distance;
    if (own.triangle != nearest.triangle && is_over(own, search.thickness) && nearer) beside = own;
    mine = beside.other >= 0;
    const double next = least_of(mine ? beside.touch.distance : 1e300);
    mine = mine && beside.touch.distance == next;
    share(beside, lane_with(mine, beside.triangle));
    mine = first.other >= 0;
    const double entry = least_of(mine ? first.touch.entry : 1e300);
    mine = mine && first.touch.entry == entry;
    const double distance = least_of(mine ? first.touch.distance : 1e300);
    mine = mine && first.touch.distance == distance;
    share(first, lane_with(mine, first.triangle));
}

// Searches the triangles of a body, by a warp, once for all searches: all lanes have what was found. queue: (QUEUE,) of the warp.
// look(triangle, search): at one of them
template <class Look>
__device__ __forceinline__ void search_body(const IslandArguments& a, int body, TouchSearch<Motion>* search, int count, int* queue, Look look) {
    const int lane = threadIdx.x % 32, last = a.leaf_start[body + 1];
    Box box = search[0].box;
    for (int i = 1; i < count; ++i) box = joined(box, search[i].box);
    int waiting = 0;
    if (!meet(a.t.tree_box[a.t.tree_start[body]], box)) return;
    for (int from = a.leaf_start[body]; from < last || waiting; from += 32) {
        const int k = from + lane < last ? a.leaf[from + lane] : -1;
        const bool met = k >= 0 && meet(a.t.tree_box[k], box);
        const unsigned lanes = __ballot_sync(WARP, met);
        if (met) queue[waiting + __popc(lanes & ((1u << lane) - 1))] = k;
        waiting += __popc(lanes);
        __syncwarp();
        if (waiting < 32 && from + 32 < last) continue;
        const int taken = waiting < 32 ? waiting : 32, mine = lane < taken ? queue[waiting - taken + lane] : -1;
        __syncwarp();
        waiting -= taken;
        if (mine >= 0)
            for (int i = 0; i < count; ++i)
                if (count == 1 || meet(a.t.tree_box[mine], search[i].box)) look(~a.t.tree_child[2 * mine], search[i]);
    }
    for (int i = 0; i < count; ++i) agree(search[i]);
}
__device__ void search_body(const IslandArguments& a, int body, TouchSearch<Motion>* search, int count, int* queue) {
    search_body(a, body, search, count, queue, [&](int triangle, TouchSearch<Motion>& one) { consider(a.t, body, triangle, one); });
}

// The same of a vertex and its own body, as search_own.
__device__ __forceinline__ TouchSearch<Motion> search_own_body(const IslandArguments& a, const Motion& m, int body, int node, double thickness, int* queue) {
    const OwnTables own = own_tables(a);
    TouchSearch<Motion> search = own_search_of(m, node, thickness);
    search_body(a, body, &search, 1, queue,
                [&](int triangle, TouchSearch<Motion>& one) { consider_own(a.t, own, m, body, node, triangle, one, nullptr); });
    return search;
}
// As passes_own.
__device__ bool passes_own_body(const IslandArguments& a, const Motion& m, int body, int node, int* queue, Meeting& found) {
    const double thickness = thickness_of(a.t, body);
#pragma unroll 1
    for (double near = THROUGH * thickness;; near = thickness) {  // one copy of a large text
        found = found_by(search_own_body(a, m, body, node, near, queue));
        if (near == thickness) return found.other >= 0;
        if (!(found.other >= 0 && found.touch.entry <= 1)) return false;
    }
}

// A warp has a vertex of a surface: sets its rows, as detect_site.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) pair_sites(const IslandArguments a) {
    __shared__ int queues[CONTACT_THREADS / 32][QUEUE];
    const int warp = threadIdx.x / 32, site = blockIdx.x * (CONTACT_THREADS / 32) + warp, lane = threadIdx.x % 32;
    if (site >= sites_before(a.t, a.bodies_count)) return;
    const int body = a.t.site_body[site], node = node_of_site(a.t, site), row = a.t.pair_first + 2 * site;
    if (!a.near[body] && !a.was_near[body]) return;
    const Motion m = motion_of(a, false);
    Meeting first = {-1, -1, {}}, second = first, beside = first;
    const Box box = a.c.free[node] == 0 ? empty_box() : box_of(m, node, thickness_of(a.t, body));
    auto take = [&](const TouchSearch<Motion>& search) {
        const Meeting t = found_by(search);
        if (comes_before(t, first)) { second = first; first = t; }
        else if (comes_before(t, second)) second = t;
        if (in_crease(search) && comes_before(search.beside, beside)) beside = search.beside;
    };
    for (int from = 0; from < a.bodies_count; from += 32) {
        const int there = from + lane;
        const bool met = there < a.bodies_count && there != body && meets_others(a, there) && meet(box, a.t.body_box[there]);
        for (unsigned lanes = __ballot_sync(WARP, met); lanes; lanes &= lanes - 1) {
            const int other = from + __ffs(lanes) - 1;
            TouchSearch<Motion> search = search_of(m, node, 0.5 * (thickness_of(a.t, body) + thickness_of(a.t, other)));
            search_body(a, other, &search, 1, queues[warp]);
            take(search);
        }
    }
    if (HAS_OWN && a.c.free[node] != 0 && !is_bound(a, node, body)) take(search_own_body(a, m, body, node, thickness_of(a.t, body), queues[warp]));
    if (lane > 0) return;
    if (second.other < 0) second = beside;
    const RowMemory last[2] = {memory_of(a.t, row), memory_of(a.t, row + 1)};
    put_row(a.t, m, row, site, first);
    put_row(a.t, m, row + 1, site, second);
    recall_both(a.t, row, last);
}

__device__ void take_anew(const IslandArguments& a, int r) {
    DeviceRow& row = a.c.row[r];
    row.limit = row.dual[0] = row.dual[1] = row.dual[2] = 0;
    row.in_set = 0;
    row.force = {0, {0, 0, 0}, 0, false};
    for (int k = 0; k < 6; ++k) a.row[r].known[k] = 0;
}

// Gives a body that a vertex touches one of its rows: that body's own, an empty one, or the one that carries less.
__device__ void take_pair_row(const IslandArguments& a, int site, const Meeting& t) {
    const int pair = a.t.pair_first + 2 * site;
    int r = pair;
    if (a.t.obstacle[pair] == t.other && a.t.obstacle[pair + 1] == t.other) {  // both sides of a crease
        r += dot3(a.t.normal + 3 * (pair + 1), t.touch.normal) > dot3(a.t.normal + 3 * pair, t.touch.normal);
    } else if (a.t.obstacle[pair] != t.other) {
        const bool next = a.t.obstacle[pair + 1] == t.other || a.t.obstacle[pair + 1] < 0;
        r += next || (a.t.obstacle[pair] >= 0 && a.c.row[pair + 1].force.normal < a.c.row[pair].force.normal);
    }
    if (a.t.obstacle[r] == t.other && dot3(a.t.normal + 3 * r, t.touch.normal) > SAME_PLANE) {
        a.t.hardening[r] = fmin(HARDER * a.t.hardening[r], HARDEST);
        return;
    }
    put_row(a.t, motion_of(a, false), r, site, t);
    take_anew(a, r);
}

// A warp has a vertex: gives it a row where the solution moves it through a triangle, or into a body that it was outside of, or makes
// its row stiffer.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) pair_sweep(const IslandArguments a) {
    __shared__ int queues[CONTACT_THREADS / 32][QUEUE];
    const int warp = threadIdx.x / 32, site = blockIdx.x * (CONTACT_THREADS / 32) + warp, lane = threadIdx.x % 32;
    if (site >= sites_before(a.t, a.bodies_count)) return;
    const bool holds = holds_apart(a);
    int held = 0;
    const int body = a.t.site_body[site], node = node_of_site(a.t, site);
    if (!a.near[body]) return;
    if (site == sites_before(a.t, body) && lane == 0) a.was_near[body] = 1;  // its rows are looked at again in the next step
    if (a.c.free[node] == 0 || (holds && is_lost(a, body))) return;
    const Motion m = way_of_step(a);
    Motion ended = m;
    ended.x = a.ends;
    ended.predictor = nullptr;
    const Box box = box_of(m, node, thickness_of(a.t, body));
    auto take = [&](int other, const Meeting& t, double thickness) {
        if (holds) {
            if (held < MOST_HELD && !is_lost(a, other)) {
                a.held[MOST_HELD * (site + edges_before(a, body)) + held++] = held_vertex(a.t, node, body, t, thickness);
                a.tally->found = 1;
            }
            return;
        }
        take_pair_row(a, site, t);
        a.touched[body] = a.touched[other] = a.tally->found = 1;
    };
    for (int from = 0; from < a.bodies_count; from += 32) {
        const int there = from + lane;
        const bool met = there < a.bodies_count && there != body && meets_others(a, there) && !is_bound(a, node, there) && meet(box, a.t.body_box[there]);
        for (unsigned lanes = __ballot_sync(WARP, met); lanes; lanes &= lanes - 1) {
            const int other = from + __ffs(lanes) - 1;
            TouchSearch<Motion> search[3];
            const double thickness = 0.5 * (thickness_of(a.t, body) + thickness_of(a.t, other));
            searches_of_passage(m, ended, node, thickness, search);
            search_body(a, other, search, 3, queues[warp]);
            Meeting t;
            if (passage_found(search, t) == STAYS_OUT || lane > 0) continue;
            take(other, t, thickness);
        }
    }
    if (!HAS_OWN || is_bound(a, node, body)) return;
    Meeting t;
    if (passes_own_body(a, m, body, node, queues[warp], t) && lane == 0) take(body, t, thickness_of(a.t, body));
}

// --- edges --------------------------------------------------------------------------------------------------------------------------

// What an edge may touch of its own body.
__device__ EdgeMeetings own_edges(const IslandArguments& a, const Motion& m, int body, int edge) {
    EdgeMeetings found = no_edges();
    if (!HAS_OWN) return found;
    meet_each_own_edge(a.t, a.e, own_tables(a), m, body, edge, nullptr, [&](const EdgeMeeting& here) {
        if (!are_bound(a, a.e.edge + 2 * edge, body, a.e.edge + 2 * here.edge, body)) take(found, here);
    });
    return found;
}

// A thread has an edge: sets its rows, as detect_edge.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) pair_edges(const IslandArguments a) {
    const int edge = blockIdx.x * CONTACT_THREADS + threadIdx.x;
    if (edge >= a.edges) return;
    const int body = a.edge_body[edge];
    if (!a.near[body] && !a.was_near[body]) return;
    if (!a.near[body]) a.e.wings[edge].sharp = 0;
    const Motion m = motion_of(a, false);
    const int dropped = detect_edge(a.t, a.e, m, body, edge, own_edges(a, m, body, edge));
    if (dropped)
        if (const int site = site_of_edge(a.t, a.e, edge); site >= 0) atomicAdd(a.dropped + site, dropped);
}

// A thread has an edge: gives it a row where the solution moves it through another one, or makes its row stiffer.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) edge_sweep(const IslandArguments a) {
    const int edge = blockIdx.x * CONTACT_THREADS + threadIdx.x;
    if (edge >= a.edges || !a.near[a.edge_body[edge]]) return;
    const int body = a.edge_body[edge];
    const bool holds = holds_apart(a);
    if (holds && is_lost(a, body)) return;
    const Motion m = way_of_step(a);
    int held = 0;
    auto take = [&](int other, int facing, double thickness, const EdgeTouch& t) {
        if (are_bound(a, a.e.edge + 2 * edge, body, a.e.edge + 2 * facing, other)) return;
        if (holds) {
            if (held >= MOST_HELD || is_lost(a, other)) return;
            a.held[MOST_HELD * (sites_before(a.t, body + 1) + edge) + held++] =
                held_edges(a.e.edge + 2 * edge, a.e.edge + 2 * facing, body, other, t.s, t.t, t.normal, thickness);
            a.tally->found = 1;
            return;
        }
        const int r = take_edge_row(a.t, a.e, m, body, edge, {other, facing, t}, [&](int row) { return a.c.row[row].force.normal; });
        if (r >= 0) take_anew(a, r);
        a.touched[body] = a.touched[other] = a.tally->found = 1;
    };
    each_edge_passed(a.t, a.e, m, body, edge, take);
    if (HAS_OWN)
        each_own_edge_passed(a.t, a.e, own_tables(a), m, body, edge, [&](int facing, const EdgeTouch& t) { take(body, facing, thickness_of(a.t, body), t); });
}

// --- after a sweep ------------------------------------------------------------------------------------------------------------------

// Holds the places found apart, by their order: vertices of a body, then its edges. Returns whether anything moved, in all threads. Done by
// one thread block.
__device__ bool hold_places(const IslandArguments& a) {
    __shared__ int before[LISTING_THREADS];
    __shared__ bool moved;
    const int n = a.bodies_count, me = threadIdx.x, slots = MOST_HELD * (sites_before(a.t, n) + a.edges);
    const int each = (slots + LISTING_THREADS - 1) / LISTING_THREADS, begin = min(me * each, slots), end = min(begin + each, slots);
    int own = 0;
    for (int k = begin; k < end; ++k) own += a.held[k].other >= 0;
    before[me] = own;
    __syncthreads();
    for (int by = 1; by < LISTING_THREADS; by *= 2) {
        const int other = me >= by ? before[me - by] : 0;
        __syncthreads();
        before[me] += other;
        __syncthreads();
    }
    int* to = a.held_list + before[me] - own;
    for (int k = begin; k < end; ++k)
        if (a.held[k].other >= 0) *to++ = k;
    __syncthreads();
    if (me == 0) {
        const Motion m = motion_of(a, true);
        moved = false;
        for (int k = 0; k < before[LISTING_THREADS - 1]; ++k) {
            HeldPlace& p = a.held[a.held_list[k]];
            if (hold_apart(m, a.mass, p, a.c.y, [&](int corner) { return a.c.free[p.node[corner]] != 0; })) {
                ++a.held_count[p.body];
                if (!HAS_OWN || p.other != p.body) ++a.held_count[p.other];
                moved = true;
            }
            p.other = -1;
        }
    }
    __syncthreads();
    for (int i = me; i < n; i += LISTING_THREADS) {  // bodies that are solved together tell the same
        int most = a.held_count[i];
        for (int j = 0; j < n && a.island_of[i] >= 0; ++j)
            if (a.island_of[j] == a.island_of[i] && a.held_count[j] > most) most = a.held_count[j];
        a.c.pair_clipped[i] = most;
    }
    return moved;
}

// One thread block: whether there is more to solve, or to hold apart.
extern "C" __global__ void __launch_bounds__(LISTING_THREADS) end_sweep(const IslandArguments a) {
    Tally& tally = *a.tally;
    const bool holds = holds_apart(a), found = __ldcg(&tally.found);
    __syncthreads();  // all threads have read them
    const bool moved = holds && found && hold_places(a);
    if (threadIdx.x > 0) return;
    tally.again = !holds && found;
    tally.rounds += tally.again;
    tally.holds += moved;
    tally.go = tally.again || (moved && tally.holds < PAIR_HOLDS);
}

// --- islands ------------------------------------------------------------------------------------------------------------------------

// A thread has a node: forgets what acts there, and looks at its forces. `bad` is 0 before.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) look_at_bodies(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int i = here.begin + threadIdx.x;
    if (i >= here.end) return;
    a.count[i] = a.cursor[i] = 0;
    if (i == here.begin && (int)blockIdx.x == here.first) a.c.pair_contacts[here.body] = 0;
    for (int k = 0; k < 3; ++k)
        if (!(fabs((double)a.c.b[3ll * i + k]) < 1e150)) a.bad[here.body] = 1;
}

// A thread block has a body: lists its rows, and counts those that act at each node. Rows with a body whose forces are not finite go.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) list_island_rows(const IslandArguments a, int swept) {
    __shared__ double least[CONTACT_THREADS];
    const int body = blockIdx.x;
    double earliest = NEVER;
    each_own_row(a.c, body, [&](int r) { earliest = fmin(earliest, a.t.entry[r]); });
    each_pair_range(a, body, [&](int first, int last) {
        for (int p = first + threadIdx.x; p < last; p += CONTACT_THREADS) {
            const int other = a.t.obstacle[p];
            if (other < 0) continue;
            if (a.bad[body] || a.bad[other]) {
                a.t.obstacle[p] = -1;
                continue;
            }
            if (!is_tie(a, p)) earliest = fmin(earliest, a.t.entry[p]);
            each_corner(a, p, [&](int node, double, int) { atomicAdd(a.count + node, 1); });
        }
    });
    least[threadIdx.x] = earliest;
    __syncthreads();
    for (int k = CONTACT_THREADS / 2; k; k /= 2) {
        if ((int)threadIdx.x < k) least[threadIdx.x] = fmin(least[threadIdx.x], least[threadIdx.x + k]);
        __syncthreads();
    }
    if (threadIdx.x == 0) {
        a.earliest[body] = least[0];
        if (!swept) a.was_near[body] = a.near[body];
    }
    list_own_rows(a, body);
}

// The state of an island before its solve; after a sweep it goes on with what its first body has.
__device__ IslandState state_of(const IslandArguments& a, int first, int bodies, int chunks, int modes, int phase) {
    IslandState s = {};
    s.residual = __longlong_as_double(0x7ff8000000000000ll);
    s.phase = phase;
    s.bodies = bodies;
    s.chunks = chunks;
    s.modes = modes;
    s.factors = 1;
    if (phase == ISLAND_BEGINS) return s;
    const PcgResult& result = a.c.results[(a.c.step[0] % a.c.capacity) * a.bodies_count + first];
    s.residual = a.c.state[first].residual;
    s.passes = a.c.state[first].passes;
    s.iterations = result.iterations;
    s.status = result.status;
    s.fallbacks = result.fallbacks;
    s.solved = result.residual;
    s.seconds = result.seconds;
    return s;
}

constexpr int LONE = HAS_SINGLES ? 0 : 1;  // what counts as the size of the island of a body that is none

// True if a body that touches no other is an island: the last one of its rows, whose ties come last, is a tie, or it touches itself.
__device__ bool is_single(const IslandArguments& a, int body) {
    const int rows = a.own_rows[body];
    if (HAS_OWN) return a.pair_rows[body] > 0;
    return HAS_TIES && rows > 0 && is_tie(a, own_list(a, body)[rows - 1]);
}

// One thread block: groups the bodies that have rows with each other, each group's by number; one that is tied or touches itself is a
// group even alone. swept: only those that a sweep has touched are solved again.
extern "C" __global__ void __launch_bounds__(LISTING_THREADS) find_islands(const IslandArguments a, int swept) {
    const int n = a.bodies_count, me = threadIdx.x, warp = me / 32, lane = me % 32;
    for (int i = me; i < n; i += LISTING_THREADS) {
        __stcg(a.label + i, i);
        a.bad[i] = 0;
        if (!swept) a.held_count[i] = a.c.pair_clipped[i] = 0;
    }
    __syncthreads();
    for (bool changed = true; changed;) {
        changed = false;
        for (int i = warp; i < n; i += LISTING_THREADS / 32) {
            const int rows = a.own_rows[i], pairs = a.pair_rows[i];
            for (int k = rows - pairs + lane; k < rows; k += 32) {
                const int one = __ldcg(a.label + i), two = __ldcg(a.label + a.t.obstacle[own_list(a, i)[k]]);
                if (one == two) continue;
                atomicMin(a.label + (one > two ? one : two), min(one, two));
                changed = true;
            }
        }
        __syncthreads();
        for (int i = me; i < n; i += LISTING_THREADS) {
            int root = __ldcg(a.label + i);
            while (__ldcg(a.label + root) != root) root = __ldcg(a.label + root);
            __stcg(a.label + i, root);
        }
        changed = !__syncthreads_and(!changed);
    }
    // the place of a body is that among those of earlier islands and its own; O(bodies^2) / threads
    const int* label = a.label;
    int* members = a.touched + n;
    for (int i = me; i < n; i += LISTING_THREADS) {
        int size = 0;
        for (int j = 0; j < n; ++j) size += label[j] == label[i];
        members[i] = HAS_SINGLES && size == 1 && !is_single(a, i) ? LONE : size;
    }
    __syncthreads();
    __shared__ int islands, active, alone;
    if (me == 0) islands = active = alone = 0;
    __syncthreads();
    for (int i = me; i < n; i += LISTING_THREADS) {
        const int own = label[i], size = members[i];
        if (size == LONE) {
            a.island_of[i] = a.mode[i] = -1;
            atomicAdd(&alone, 1);
            continue;
        }
        int number = 0, first = 0, rank = 0, free_rank = 0, frees = 0, again = 0, chunks = 0;
        for (int j = 0; j < n; ++j) {
            if (label[j] == j && j < own && members[j] > LONE) {
                ++number;
                first += members[j];
            }
            if (label[j] != own) continue;
            rank += j < i;
            free_rank += j < i && a.unheld[j];
            frees += a.unheld[j];
            chunks += a.chunk_first[j + 1] - a.chunk_first[j];
            again |= a.touched[j];
        }
        const bool few = MODES * frees <= a.most_modes;
        a.island_of[i] = number;
        a.island[first + rank] = i;
        a.mode[i] = a.unheld[i] && few ? MODES * free_rank : -1;
        if (a.mode[i] >= 0) a.free_body[first + free_rank] = i;
        if (i != own) continue;
        a.island_start[number] = first;
        a.state[number] = state_of(a, i, size, chunks, few ? MODES * frees : 0, !swept ? ISLAND_BEGINS : again ? ISLAND_RESUMES : ISLAND_OVER);
        atomicAdd(&islands, 1);
        if (a.state[number].phase != ISLAND_OVER) atomicAdd(&active, 1);
    }
    __syncthreads();
    if (me > 0) return;
    Tally& tally = *a.tally;
    a.island_start[islands] = n - alone;
    tally.islands = islands;
    tally.active = active;
    tally.alone = alone;
    tally.iterating = tally.entries = 0;
    if (swept) return;
    tally.go = 1;
    tally.rounds = tally.holds = 0;
}

// A thread has a node: makes room for what acts there.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) place_entries(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int i = here.begin + threadIdx.x;
    if (i < here.end && a.count[i]) a.start[i] = atomicAdd(&a.tally->entries, a.count[i]);
}

// A thread block has a body: lists its rows with others, and what they do at nodes, those of a node in any order.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) fill_entries(const IslandArguments a) {
    const int body = blockIdx.x, rows = a.own_rows[body], pairs = a.pair_rows[body];
    double before[1] = {0};
    for (int j = threadIdx.x; j < body; j += CONTACT_THREADS) before[0] += a.pair_rows[j];
    sum_block(before);
    if (body == a.bodies_count - 1 && threadIdx.x == 0) a.tally->pairs = (int)before[0] + pairs;
    for (int k = threadIdx.x; k < pairs; k += CONTACT_THREADS) {
        const int r = own_list(a, body)[rows - pairs + k];
        int* to = a.pair_list + 3 * ((int)before[0] + k);
        to[0] = r;
        to[1] = body;
        to[2] = HAS_TIES && !is_pair(a, r) ? -1 : a.t.obstacle[r];
        each_corner(a, r, [&](int node, double, int corner) { a.entry[a.start[node] + atomicAdd(a.cursor + node, 1)] = CORNERS * r + corner; });
    }
}
