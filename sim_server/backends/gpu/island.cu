// SPDX-License-Identifier: MIT
// Bodies that touch each other, solved as one system on a GPU (order: island_state.cuh; method: backends/cpu/native/passes.h, island.h).
//
// Conjugate gradients for (A + H^T S H) dy = r from zero, preconditioned by each body's factor (island_factor.cu), or block Jacobi, then
// by the rigid motions Z of the free bodies:
//     z' = P r,   z = z' + Z E^-1 Z^T (r - A z'),   E = Z^T A Z
// with Z^T r = 0 at the start, where this is the balanced form of island.h (A-DEF2 of Tang, Nabben, Vuik and Erlangga 2009). A z follows
// from A z' and A Z, A p from A z: one product and one solve with E an iteration, whose sums are made at its end, all at once.
#include "island_state.cuh"
#ifdef FACE_ROWS
#include "face_sweep.cuh"
#endif
#include "invert3.cuh"
#ifdef ERRORS
#include "island_error.cuh"
#endif

constexpr int ROW_SUMS = HAS_TIES ? 2 : 1;  // rows whose state is not that of the set, and those that are no ties

enum Evaluation { WARM_START = 0, ZERO_START = 1, LAW_AT_START = 2, LAW = 3 };  // what rows are evaluated for

__device__ __forceinline__ bool takes_part(int phase, int what) { return phase == (what == LAW ? ISLAND_READY : ISLAND_BEGINS); }
__device__ __forceinline__ bool solves(int phase) { return phase == ISLAND_SOLVES || phase == ISLAND_GOES_ON; }
__device__ __forceinline__ bool has_factor(const PcgBody& body) { return body.kind == CHOLESKY && body.plan; }

// --- rows and nodes -----------------------------------------------------------------------------------------------------------------

// f(row, weight) of what acts at a node.
template <class F> __device__ __forceinline__ void each_entry(const IslandArguments& a, int body, int node, F f) {
    const int pair = a.c.pair[node];
    if (a.c.free[node] == 0) return;
    for (int r = pair; pair >= 0 && r < pair + 2; ++r)
        if (used(a.c, r)) f(r, 1.0, 0);
    if (FACES && pair >= 0 && a.c.faces.rows[body] > 0)
        each_face_row(a.c, node, [&](int r, int corner, int) { f(r, a.t.weight[CORNERS * r + corner], corner); });
    const int first = a.start[node], last = first + a.count[node];
    for (int k = first; k < last; ++k) {
        const int entry = a.entry[k], r = entry / CORNERS, corner = entry % CORNERS;
        f(r, a.t.weight[entry], corner);
    }
}

// f += R^T sum of what rows have in a vector of theirs
template <class Of> __device__ __forceinline__ void add_entries(const IslandArguments& a, int body, int node, double* f, Of of) {
    double sum[3] = {0, 0, 0}, out[3];
    each_entry(a, body, node, [&](int r, double weight, int) {
        const double* v = of(a.row[r]);
        for (int k = 0; k < 3; ++k) sum[k] += weight * v[k];
    });
    rotated_back(rotation_of(a, node), sum, out);
    for (int k = 0; k < 3; ++k) f[k] += out[k];
}

// Arm of a node about the first one of its body.
__device__ __forceinline__ void arm_of(const IslandArguments& a, int body, int node, double* arm) {
    const long long origin = 3ll * a.bodies[body].first;
    for (int k = 0; k < 3; ++k) arm[k] = (double)a.c.x[3ll * node + k] - (double)a.c.x[origin + k];
}
// R^T (t + w x arm)
__device__ __forceinline__ void rigid_velocity(const local* R, const double* arm, const double* m, double* out) {
    const double v[3] = {m[0] + m[4] * arm[2] - m[5] * arm[1], m[1] + m[5] * arm[0] - m[3] * arm[2], m[2] + m[3] * arm[1] - m[4] * arm[0]};
    rotated_back(R, v, out);
}
// m += Z^T r of a node
__device__ __forceinline__ void project_rigid(const local* R, const double* arm, const double* r, double* m) {
    double f[3];
    rotated(R, r, f);
    for (int k = 0; k < 3; ++k) m[k] += f[k];
    m[3] += arm[1] * f[2] - arm[2] * f[1];
    m[4] += arm[2] * f[0] - arm[0] * f[2];
    m[5] += arm[0] * f[1] - arm[1] * f[0];
}
// u += W t + w x lever
__device__ __forceinline__ void see(const double* lever, const double* m, double* u) {
    u[0] += lever[0] * m[0] + m[4] * lever[3] - m[5] * lever[2];
    u[1] += lever[0] * m[1] + m[5] * lever[1] - m[3] * lever[3];
    u[2] += lever[0] * m[2] + m[3] * lever[2] - m[4] * lever[1];
}

// --- the start of a step ------------------------------------------------------------------------------------------------------------

// Sorts what acts at a node.
__device__ void sort_entries(const IslandArguments& a, int i) {
    const int first = a.start[i], last = first + a.count[i];
    for (int k = first + 1; a.count[i] && k < last; ++k) {
        const int entry = a.entry[k];
        int at = k;
        for (; at > first && a.entry[at - 1] > entry; --at) a.entry[at] = a.entry[at - 1];
        a.entry[at] = entry;
    }
}

// A thread has a node. Sorts what acts at it, keeps its block as a factor is to know it, left = b - A y; A Z and Z^T A Z of its body.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_start(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int body = here.body, island = island_of(a, body);
    if (island < 0) return;
    const int phase = a.state[island].phase, i = here.begin + threadIdx.x;
    if (i < here.end) sort_entries(a, i);  // also of islands that are over: they are listed anew, and read once more
    if (phase != ISLAND_BEGINS && phase != ISLAND_RESUMES) return;
    double sum[BASE_SUMS] = {};
    if (i < here.end) {
        const int pair = a.c.pair[i];
        if (phase == ISLAND_BEGINS) {
            keep_block(a.c, SurfaceNode::at(a.c, i), body);
        } else if (pair >= 0) {  // it may have been alone
            for (int k = 0; k < 9; ++k) a.c.values[9ll * a.c.place[i] + k] = a.c.base[9ll * (pair / 2) + k];
            const SurfaceNode n = SurfaceNode::at(a.c, i);
            if (has_faces(a.c, n, body)) give_links(a.c, n, a.c.faces.base);
        }
        double Ay[3] = {0, 0, 0}, AZ[3][MODES] = {};
        for (int k = a.row_start[i]; k < a.row_start[i + 1]; ++k) {
            const real* block = a.c.values + 9ll * k;
            const int j = a.columns[k];
            double y[3], arm[3], B[9];
            load3(a.c.y, j, y);
            for (int m = 0; m < 9; ++m) B[m] = block[m];
            for (int m = 0; m < 3; ++m) Ay[m] += B[3 * m] * y[0] + B[3 * m + 1] * y[1] + B[3 * m + 2] * y[2];
            if (a.mode[body] < 0) continue;
            arm_of(a, body, j, arm);
            for (int n = 0; n < MODES; ++n) {
                double unit[MODES] = {}, v[3];
                unit[n] = 1;
                rigid_velocity(rotation_of(a, j), arm, unit, v);
                for (int m = 0; m < 3; ++m) AZ[m][n] += B[3 * m] * v[0] + B[3 * m + 1] * v[1] + B[3 * m + 2] * v[2];
            }
        }
        for (int m = 0; m < 3; ++m) {
            a.left[3ll * i + m] = (double)a.c.b[3ll * i + m] - Ay[m];
            for (int n = 0; n < MODES; ++n) a.modes[MODES * (3ll * i + m) + n] = AZ[m][n];
        }
        if (a.mode[body] >= 0) {
            double arm[3];
            arm_of(a, body, i, arm);
            for (int n = 0; n < MODES; ++n) {
                double column[3] = {AZ[0][n], AZ[1][n], AZ[2][n]}, m[MODES] = {};
                project_rigid(rotation_of(a, i), arm, column, m);
                for (int k = 0; k < MODES; ++k) sum[MODES * k + n] = m[k];
            }
        }
    }
    if (a.mode[body] < 0) return;
    sum_block(sum);
    for (int k = threadIdx.x; k < BASE_SUMS; k += CONTACT_THREADS) a.base_sums[(long long)BASE_SUMS * blockIdx.x + k] = pick(sum, k);
}

// --- the law ------------------------------------------------------------------------------------------------------------------------

// Displacement of a row's point by velocities y; zero: y is zero.
__device__ __forceinline__ void point_displacement(const IslandArguments& a, int r, bool zero, double* s) {
    s[0] = s[1] = s[2] = 0;
    auto add = [&](int node, double weight) {
        double u[3] = {0, 0, 0}, y[3];
        if (!zero && a.c.free[node] != 0) {
            load3(a.c.y, node, y);
            rotated(rotation_of(a, node), y, u);
        }
        for (int k = 0; k < 3; ++k) s[k] += weight * a.c.dx_dv * ((double)a.c.predictor[3ll * node + k] + u[k]);
    };
    if (is_of_node(a, r)) return add(a.c.node[r], 1);
    for (int k = 0; k < CORNERS; ++k)
        if (a.t.corner[CORNERS * r + k] >= 0) add(a.t.corner[CORNERS * r + k], a.t.weight[CORNERS * r + k]);
}

__device__ __forceinline__ void set_lever(const IslandArguments& a, int r, double* lever) {
    for (int k = 0; k < 8; ++k) lever[k] = 0;
    each_corner(a, r, [&](int node, double weight, int corner) {
        const bool other = is_other_side(a, r, corner);
        double *side = lever + 4 * other, arm[3];
        arm_of(a, body_of_row(a, r, other), node, arm);
        side[0] += weight;
        for (int k = 0; k < 3; ++k) side[1 + k] += weight * arm[k];
    });
}

// The law of a tie, as evaluate and contact_stiffness.
__device__ __forceinline__ void evaluate_tie(const IslandArguments& a, int r, const double* s) {
    DeviceRow& row = a.c.row[r];
    for (int k = 0; k < 3; ++k) row.s[k] = s[k];
    row.force = force_of_tie(a.ties, r - a.ties.first, s);
}
__device__ __forceinline__ void set_tie_stiffness(const IslandArguments& a, int r, double* k) {
    stiffness_of_tie(a.ties, r - a.ties.first, a.c.dx_dv * a.c.force_coefficient, k);
}

// A thread block has a body: forces and stiffness of its rows.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_law(const IslandArguments a, int what) {
    const int body = blockIdx.x, island = island_of(a, body);
    if (island < 0) return;
    const IslandState& state = a.state[island];
    if (!takes_part(state.phase, what)) return;
    if (state.relist) list_own_rows(a, body);
    __syncthreads();
    const int rows = __ldcg(a.own_rows + body);
    const int* list = own_list(a, body);
    double earliest = NEVER, changed[ROW_SUMS] = {};
    if (what == WARM_START)
        for (int k = 0; k < state.bodies; ++k) earliest = fmin(earliest, a.earliest[a.island[a.island_start[island] + k]]);
    for (int k = threadIdx.x; k < rows; k += CONTACT_THREADS) {
        const int r = list[k];
        DeviceRow& row = a.c.row[r];
        IslandRow& own = a.row[r];
        if (what == WARM_START) {  // rows that count as closed in the first pass
            begin_friction(a.c, r);
            row.in_set = is_tie(a, r) || a.c.force[r] > 0 || (a.c.entry[r] <= 1 && a.c.entry[r] <= earliest + FIRST);
            for (int m = 0; m < 6; ++m) own.known[m] = 0;
            if (is_tie(a, r)) set_tie_stiffness(a, r, own.known);
            else if (a.c.force[r] > 0) {
                const ContactForce f = lasting_contact(a.c.friction[r], a.c.force[r], a.c.traction + 3 * r);
                contact_stiffness(row_at(a.c, r), f, f.traction, a.c.dx_dv * a.c.force_coefficient, own.known);
            }
        }
        double s[3];
        point_displacement(a, r, what == ZERO_START || (what == LAW_AT_START && state.zero), s);
        const ContactRow given = row_at(a.c, r);
        if (is_tie(a, r)) evaluate_tie(a, r, s);
        else
            evaluate(a.c, r, s, what == LAW && state.hold, what == LAW ? state.set : what != LAW_AT_START,
                     what == LAW && state.rested && state.passes == 0);
        for (int m = 0; m < 3; ++m)
            own.impulse[m] = a.c.force_coefficient * (row.force.normal * a.c.normal[3 * r + m] + row.force.traction[m]);
        if (what != LAW) continue;
        if (is_tie(a, r)) set_tie_stiffness(a, r, own.stiffness);
        else contact_stiffness(given, row.force, row.dual, a.c.dx_dv * a.c.force_coefficient, own.stiffness);
        set_lever(a, r, own.lever);
        if (is_tie(a, r)) continue;
        changed[0] += state.set && row.in_set != (int)contact_force(given, s, 0, false).closed;
        if (HAS_TIES) changed[ROW_SUMS - 1] += 1;
    }
    if (what != LAW) return;
    sum_block(changed);
    if (threadIdx.x > 0) return;
    a.row_sums[body] = changed[0];
    if (HAS_TIES) a.row_sums[a.bodies_count + body] = changed[ROW_SUMS - 1];
}

// A thread has a node: r0 = left + i H^T f; squares of it, of b + i H^T f and of b.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_balance(const IslandArguments a, int what) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    if (island < 0 || !takes_part(a.state[island].phase, what)) return;
    const bool zero = what == ZERO_START || (what == LAW_AT_START && a.state[island].zero);
    double sum[CG_SUMS] = {};
    if (i < here.end) {
        double f[3] = {0, 0, 0};
        add_entries(a, here.body, i, f, [](const IslandRow& row) { return row.impulse; });
        for (int k = 0; k < 3; ++k) {
            const long long at = 3ll * i + k;
            const double b = a.c.b[at];
            if (what == LAW_AT_START && zero) {
                a.c.y[at] = 0;
                a.left[at] = b;
            }
            const double r = (zero ? b : a.left[at]) + f[k];
            a.r0[at] = r;
            sum[0] += r * r;
            sum[1] += (b + f[k]) * (b + f[k]);
            sum[2] += b * b;
        }
    }
    sum_block(sum);
    if (threadIdx.x < CG_SUMS) a.chunk_sums[(long long)CG_SUMS * blockIdx.x + threadIdx.x] = pick(sum, threadIdx.x);
}

// Sets what a solve begins with. factors: 0: there is none. end2: square of the residual to which it is expected to go.
__device__ void choose_factors(const IslandArguments& a, int island, IslandState& s, long long factors, double end2) {
    s.choice = {{FACTOR_COST, 1}, 0, factors, 1, 0, 0};
    s.start2 = s.r2;
    s.switched_after = s.fell = 0;
    if (factors > 0) begin_pass(a.choice[a.island[a.island_start[island]]], s.choice, sqrt(end2 / s.r2));
    s.factors = !s.choice.first;
}

// A thread block has an island: what follows from its residual.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_decide(const IslandArguments a, int what) {
    const int island = blockIdx.x;
    if (island >= a.tally->islands) return;
    IslandState s = a.state[island];
    if (what == LAW && s.phase == ISLAND_GOES_ON && threadIdx.x == 0) {
        a.state[island].stage = s.coarse ? BEGINS_COARSE : ITERATES;
        atomicAdd(&a.tally->iterating, 1);
    }
    if (what == LAW_AT_START && s.phase == ISLAND_RESUMES) {
        s.phase = ISLAND_READY;
        if (threadIdx.x == 0) a.state[island] = s;
        return;
    }
    if (!takes_part(s.phase, what)) return;
    double sum[CG_SUMS], changed[ROW_SUMS + 1] = {};  // rows that the law does not close, those that are no ties; numbers of factors
    sum_island(a, island, a.chunk_sums, sum);
    if (what == LAW) {
        for (int k = threadIdx.x; k < s.bodies; k += CONTACT_THREADS) {
            const int member = a.island[a.island_start[island] + k];
            for (int n = 0; n < ROW_SUMS; ++n) changed[n] += a.row_sums[n * a.bodies_count + member];
            if (has_factor(a.bodies[member])) changed[ROW_SUMS] += 1.0 + a.bodies[member].factor_step;
        }
        sum_block(changed);
    }
    if (threadIdx.x > 0) return;
    const PcgBody& body = a.bodies[a.island[a.island_start[island]]];
    const double size2 = sum[0], given2 = sum[1] > sum[2] ? sum[1] : sum[2], tolerance2 = a.c.tolerance * a.c.tolerance;
    if (what == WARM_START) s.warm2 = size2;
    if (what == ZERO_START) s.zero = !body.warm_start || size2 <= s.warm2 || !isfinite(s.warm2);
    if (what == LAW_AT_START) {
        s.set = !(size2 <= tolerance2 * given2);
        s.rested = !s.set;
        s.phase = ISLAND_READY;
#ifdef ERRORS
        error_of(a, island).told = 0;
#endif
    }
    if (what == LAW) {
        s.given2 = given2;
        s.residual = given2 > 0 ? sqrt(size2 / given2) : 0;
        s.relist = s.hold = 0;
        const bool by_law = !s.set || changed[0] == 0, well = s.residual <= tolerance_of(a.c.tolerance, s.rested, s.passes, a.passes), was_last = s.last;
        const double goal2 = body.tolerance * body.tolerance * given2;
        const bool linear = HAS_TIES && changed[ROW_SUMS - 1] == 0;  // the law is linear where there are ties alone
        s.last = by_law && (linear || size2 <= tolerance2 * given2);
        if (!isfinite(size2)) {
            s.phase = ISLAND_LOST;
            s.status = NOT_FINITE;
        } else if (was_last && well) {
            s.phase = ISLAND_ENDED;
        } else if (s.last && size2 <= goal2) {
            s.phase = ISLAND_ENDED;
            s.solved = s.residual;
        } else if (!s.last && s.passes >= a.passes) {
            s.phase = ISLAND_ENDED;
        } else {
            s.phase = ISLAND_SOLVES;
            const double early = early_tolerance(s.residual, a.c.tolerance, s.passes, a.passes);
            s.goal2 = s.last ? goal2 : fmax(goal2, early * early * size2);
            s.r2 = size2;
            s.last_true2 = 1e300;
            s.coarse = s.modes > 0;
            s.stage = s.coarse ? BEGINS_COARSE : ITERATES;
            s.restart = 1;
            s.own_iterations = s.own_status = s.pending = 0;
#ifdef ERRORS
            begin_error(a, island, s, size2, s.last);
            choose_factors(a, island, s, (long long)changed[ROW_SUMS], expected_end2(a, island, s.goal2));
#else
            choose_factors(a, island, s, (long long)changed[ROW_SUMS], s.goal2);
#endif
            a.coarse_well[island] = 1;
            atomicAdd(&a.tally->iterating, 1);
        }
    }
    a.state[island] = s;
}

// --- preparation of a solve ---------------------------------------------------------------------------------------------------------

// A thread has a node: begins the solve, inverts its block with the contacts.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_prepare(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    if (island < 0 || i >= here.end) return;
    const int phase = a.state[island].phase;
    if (!solves(phase)) return;
    for (long long k = 3ll * i; k < 3ll * i + 3; ++k) {
        if (phase == ISLAND_SOLVES) {
            a.x[k] = 0;
            a.r[k] = a.r0[k];
        }
        a.z[k] = a.az[k] = a.p[k] = a.q[k] = 0;
    }
    if (phase != ISLAND_SOLVES) return;
    double block[9], S[9] = {}, sum[6] = {};
    each_entry(a, here.body, i, [&](int r, double weight, int) {
        for (int k = 0; k < 6; ++k) sum[k] += weight * weight * a.row[r].stiffness[k];
    });
    const local* R = rotation_of(a, i);
    const double full[9] = {sum[0], sum[1], sum[2], sum[1], sum[3], sum[4], sum[2], sum[4], sum[5]};
    for (int j = 0; j < 3; ++j) {
        double column[3], out[3];
        for (int m = 0; m < 3; ++m)
            column[m] = full[3 * m] * (double)R[j] + full[3 * m + 1] * (double)R[3 + j] + full[3 * m + 2] * (double)R[6 + j];
        rotated_back(R, column, out);
        for (int m = 0; m < 3; ++m) S[3 * m + j] = out[m];
    }
    for (int k = 0; k < 9; ++k) block[k] = (double)a.c.values[9ll * a.c.place[i] + k] + S[k];
    invert3(block, true, a.inverse + 9ll * i);
}

// A thread block has a free body: its rows of E = Z^T (A + H^T S H) Z. A thread has an entry of a block of MODES x MODES.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) coarse_matrix(const IslandArguments a) {
    constexpr int STAGED = 32;  // rows at a time
    __shared__ double lever[STAGED][8], stiffness[STAGED][6];
    __shared__ int other_mode[STAGED], side[STAGED], listed, before[CONTACT_THREADS];
    const int body = blockIdx.x, island = island_of(a, body);
    if (island < 0 || a.mode[body] < 0 || a.state[island].phase != ISLAND_SOLVES) return;
    const int modes = a.state[island].modes, mode = a.mode[body], me = threadIdx.x;
    double* E = a.coarse_a + (long long)MODES * a.most_modes * body;
    for (int k = 0; k < MODES; ++k)
        for (int l = me; l < modes; l += CONTACT_THREADS) E[k * a.most_modes + l] = 0;
    __syncthreads();
    for (int k = me; k < BASE_SUMS; k += CONTACT_THREADS) {
        double sum = 0;
        for (int chunk = a.chunk_first[body]; chunk < a.chunk_first[body + 1]; ++chunk) sum += a.base_sums[(long long)BASE_SUMS * chunk + k];
        E[k / MODES * a.most_modes + mode + k % MODES] = sum;
    }
    const int pairs = a.tally->pairs, own = __ldcg(a.own_rows + body) - __ldcg(a.pair_rows + body);  // first those against obstacles
    const int* list = own_list(a, body);
    for (int from = 0; from < own + pairs; from += CONTACT_THREADS) {
        // the rows among the next ones that touch the body
        const int k = from + me;
        bool mine = k < own;
        int row = mine ? __ldcg(list + k) : 0, which = 0, mode_there = -1;
        if (!mine && k < own + pairs) {
            const int* pair = a.pair_list + 3 * (k - own);
            row = pair[0];
            which = pair[2] == body && (!HAS_OWN || pair[1] != body);
            mine = pair[1] == body || which;
            if (mine && (!HAS_TIES || pair[which ? 1 : 2] >= 0)) mode_there = a.mode[pair[which ? 1 : 2]];
        }
        __syncthreads();
        before[me] = mine;
        __syncthreads();
        for (int by = 1; by < CONTACT_THREADS; by *= 2) {
            const int other = me >= by ? before[me - by] : 0;
            __syncthreads();
            before[me] += other;
            __syncthreads();
        }
        const int place = before[me] - mine, found = before[CONTACT_THREADS - 1];
        for (int stage = 0; stage < found; stage += STAGED) {
            __syncthreads();
            if (mine && place >= stage && place < stage + STAGED) {
                const IslandRow& r = a.row[row];
                for (int m = 0; m < 8; ++m) lever[place - stage][m] = r.lever[m];
                for (int m = 0; m < 6; ++m) stiffness[place - stage][m] = r.stiffness[m];
                other_mode[place - stage] = mode_there;
                side[place - stage] = which;
            }
            if (me == 0) listed = found - stage < STAGED ? found - stage : STAGED;
            __syncthreads();
            for (int at = me; at < BASE_SUMS; at += CONTACT_THREADS) {
                double unit[MODES] = {};
                const int i = at / MODES, j = at % MODES;
                for (int m = 0; m < MODES; ++m) unit[m] = m == i;
                for (int r = 0; r < listed; ++r) {
                    const double *here = lever[r] + 4 * side[r], *there = lever[r] + 4 * (1 - side[r]);
                    double u[3] = {0, 0, 0}, f[3], v[3] = {0, 0, 0}, w[3] = {0, 0, 0}, column[MODES];
                    for (int m = 0; m < MODES; ++m) column[m] = m == j;
                    see(here, unit, u);
                    stiff(stiffness[r], u, f);
                    see(here, column, v);
                    E[i * a.most_modes + mode + j] += dot3(f, v);
                    if (other_mode[r] < 0) continue;
                    see(there, column, w);
                    E[i * a.most_modes + other_mode[r] + j] += dot3(f, w);
                }
            }
        }
    }
}

// A thread block has a free body: step `pivot` of the inversion of E (Gauss-Jordan by blocks of a body), from one array to the other.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) invert_coarse(const IslandArguments a, int pivot) {
    __shared__ double P[BASE_SUMS], T[BASE_SUMS], by[MODES];
    const int body = blockIdx.x, island = island_of(a, body);
    if (island < 0 || a.mode[body] < 0 || a.state[island].phase != ISLAND_SOLVES) return;
    const int modes = a.state[island].modes, at = MODES * pivot, me = threadIdx.x;
    if (at >= modes) return;
    const int other = a.free_body[a.island_start[island] + pivot];
    const long long size = (long long)MODES * a.most_modes;
    const double *from = (pivot % 2 ? a.coarse_b : a.coarse_a) + size * body, *row = (pivot % 2 ? a.coarse_b : a.coarse_a) + size * other;
    double* to = (pivot % 2 ? a.coarse_a : a.coarse_b) + size * body;
    for (int k = me; k < BASE_SUMS; k += CONTACT_THREADS) {
        P[k] = row[k / MODES * a.most_modes + at + k % MODES];
        T[k] = from[k / MODES * a.most_modes + at + k % MODES];
    }
    __syncthreads();
    for (int k = 0; k < MODES; ++k) {  // P = its inverse
        const double diagonal = P[MODES * k + k];
        if (!(diagonal > 0) && me == 0) a.coarse_well[island] = 0;
        if (me < MODES) by[me] = P[MODES * me + k];
        __syncthreads();
        for (int n = me; n < BASE_SUMS; n += CONTACT_THREADS)
            if (n / MODES == k) P[n] = n % MODES == k ? 1 / diagonal : P[n] / diagonal;
        __syncthreads();
        for (int n = me; n < BASE_SUMS; n += CONTACT_THREADS)
            if (n / MODES != k) P[n] = (n % MODES == k ? 0 : P[n]) - by[n / MODES] * P[MODES * k + n % MODES];
        __syncthreads();
    }
    double TP[1];
    for (int n = me; n < BASE_SUMS; n += CONTACT_THREADS) {
        TP[0] = 0;
        for (int k = 0; k < MODES; ++k) TP[0] += T[n / MODES * MODES + k] * P[MODES * k + n % MODES];
        to[n / MODES * a.most_modes + at + n % MODES] = body == other ? P[n] : -TP[0];
    }
    __syncthreads();
    if (body != other) {  // T = E_ip P
        double own[(BASE_SUMS + CONTACT_THREADS - 1) / CONTACT_THREADS];
        for (int n = me, m = 0; n < BASE_SUMS; n += CONTACT_THREADS, ++m) {
            own[m] = 0;
            for (int k = 0; k < MODES; ++k) own[m] += T[n / MODES * MODES + k] * P[MODES * k + n % MODES];
        }
        __syncthreads();
        for (int n = me, m = 0; n < BASE_SUMS; n += CONTACT_THREADS, ++m) T[n] = own[m];
        __syncthreads();
    }
    for (int j = me; j < modes; j += CONTACT_THREADS) {
        if (j >= at && j < at + MODES) continue;
        double column[MODES];
        for (int k = 0; k < MODES; ++k) column[k] = row[k * a.most_modes + j];
        for (int i = 0; i < MODES; ++i) {
            double sum = body == other ? 0 : from[i * a.most_modes + j];
            for (int k = 0; k < MODES; ++k) sum += (body == other ? P[MODES * i + k] : -T[MODES * i + k]) * column[k];
            to[i * a.most_modes + j] = sum;
        }
    }
}

// --- conjugate gradients ------------------------------------------------------------------------------------------------------------

// A thread has a node: p = z + beta p, q = A z + beta q, x += alpha p, r -= alpha q; z = P r of bodies without a factor.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_update(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    if (blockIdx.x == 0 && threadIdx.x == 0) *a.c.pool_counter = 0;
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    if (island < 0 || i >= here.end) return;
    const IslandState& s = a.state[island];
    if (!solves(s.phase)) return;
#ifdef ERRORS
    if (s.pending && error_of(a, island).of.looks)
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) a.before[k] = a.x[k];
#endif
    if (s.pending)
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) {
            const double p = a.z[k] + s.beta * a.p[k], q = a.az[k] + s.beta * a.q[k];
            a.p[k] = p;
            a.q[k] = q;
            a.x[k] += s.alpha * p;
            a.r[k] -= s.alpha * q;
        }
    if (s.stage == STANDS) return;
    const double* v = a.inverse + 9ll * i;
    const double r[3] = {a.r[3ll * i], a.r[3ll * i + 1], a.r[3ll * i + 2]};
    if (s.stage == ITERATES && s.factors && has_factor(a.bodies[here.body])) return;  // island_factor.cu
    for (int k = 0; k < 3; ++k) a.z[3ll * i + k] = s.stage == ITERATES ? v[3 * k] * r[0] + v[3 * k + 1] * r[1] + v[3 * k + 2] * r[2] : 0;
}

// The first thread blocks have a body each: H v of its rows and the forces against it. In the others three threads have a node: A v
// without contacts. solution: v is that of the pass, else z.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_multiply(const IslandArguments a, int solution) {
    const bool rows_of_body = (int)blockIdx.x < a.bodies_count;
    const NodeChunk* here = rows_of_body ? nullptr : a.product_chunks + (blockIdx.x - a.bodies_count);
    const int body = rows_of_body ? blockIdx.x : here->body, island = island_of(a, body);
    if (island < 0) return;
    const IslandState& s = a.state[island];
    if (solution ? !solves(s.phase) : s.stage == STANDS) return;
    const double* v = solution ? a.x : a.z;
    if (!rows_of_body) {
        const int i = here->begin + threadIdx.x / 3, m = threadIdx.x % 3;
        if (threadIdx.x >= 3 * (CONTACT_THREADS / 3) || i >= here->end) return;
        double sum = 0;
#pragma unroll 4
        for (int k = a.row_start[i]; k < a.row_start[i + 1]; ++k) {
            const real* block = a.c.values + 9ll * k + 3 * m;
            const double* w = v + 3ll * a.columns[k];
            sum += (double)block[0] * w[0] + (double)block[1] * w[1] + (double)block[2] * w[2];
        }
        (solution ? a.solution_product : a.az)[3ll * i + m] = sum;
        return;
    }
    const int rows = a.own_rows[body];
    const int* list = own_list(a, body);
    for (int k = threadIdx.x; k < rows; k += CONTACT_THREADS) {
        IslandRow& row = a.row[list[k]];
        double u[3] = {0, 0, 0}, f[3];
        each_corner(a, list[k], [&](int node, double weight, int) {
            double w[3], out[3];
            copy3(v, node, w);
            rotated(rotation_of(a, node), w, out);
            for (int m = 0; m < 3; ++m) u[m] += weight * out[m];
        });
        stiff(row.stiffness, u, f);
        for (int m = 0; m < 3; ++m) {
            row.seen[m] = u[m];
            row.force[m] = f[m];
        }
    }
}

// A thread has a node: A z with contacts, and Z^T (r - A z).
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_product(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    if (island < 0 || a.state[island].stage == STANDS) return;
    const bool coarse = a.state[island].coarse && a.mode[here.body] >= 0;
    double sum[MODES] = {};
    if (i < here.end) {
        double az[3], r[3], arm[3];
        copy3(a.az, i, az);
        add_entries(a, here.body, i, az, [](const IslandRow& row) { return row.force; });
        copy3(a.r, i, r);
        for (int k = 0; k < 3; ++k) {
            a.az[3ll * i + k] = az[k];
            r[k] -= az[k];
        }
        if (coarse) {
            arm_of(a, here.body, i, arm);
            project_rigid(rotation_of(a, i), arm, r, sum);
        }
    }
    if (!coarse) return;
    sum_block(sum);
    if (threadIdx.x < MODES) a.coarse_sums[(long long)MODES * blockIdx.x + threadIdx.x] = pick(sum, threadIdx.x);
}

// A thread block has a free body: its part of E^-1 Z^T (r - A z).
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) coarse_solve(const IslandArguments a) {
    const int body = blockIdx.x, island = island_of(a, body);
    if (island < 0) return;
    const IslandState& s = a.state[island];
    if (s.stage == STANDS && s.pending && threadIdx.x == 0 && body == a.island[a.island_start[island]]) a.state[island].pending = 0;  // made
    if (a.mode[body] < 0 || s.stage == STANDS || !s.coarse || !a.coarse_well[island]) return;
    const int first = a.island_start[island];
    const double* E = (s.modes / MODES % 2 ? a.coarse_b : a.coarse_a) + (long long)MODES * a.most_modes * body;
    double sum[MODES] = {};
    for (int j = threadIdx.x; j < s.modes; j += CONTACT_THREADS) {
        const int other = a.free_body[first + j / MODES];
        double m = 0;
        for (int chunk = a.chunk_first[other]; chunk < a.chunk_first[other + 1]; ++chunk) m += a.coarse_sums[(long long)MODES * chunk + j % MODES];
        for (int i = 0; i < MODES; ++i) sum[i] += E[i * a.most_modes + j] * m;
    }
    sum_block(sum);
    if (threadIdx.x < MODES) a.coefficient[MODES * body + threadIdx.x] = pick(sum, threadIdx.x);
}

// The step of an island's conjugate gradients, which island_update makes. Done by a whole thread block.
__device__ void next_step(const IslandArguments& a, int island) {
    IslandState s = a.state[island];
    double sum[CG_SUMS];
    sum_island(a, island, a.chunk_sums, sum);
#ifdef ERRORS
    const Peaks peaks = peaks_of(a, island);
#endif
    if (threadIdx.x > 0) return;
    const double gamma = sum[0], delta = sum[1], infinite = 1e300;
    const bool begins = s.stage == BEGINS_COARSE;
    const PcgBody& body = a.bodies[a.island[a.island_start[island]]];
    int stop = -1;
    s.pending = 0;
    s.stage = ITERATES;
    if (s.coarse && !a.coarse_well[island]) {
        s.coarse = 0;  // E is not positive definite
        s.restart = 1;
    } else if (!(gamma > 0 && gamma < infinite && delta < infinite)) {
        if (!begins) {  // the coarse space lost its precision, or a factor is of no use
            if (!s.coarse && !s.factors) stop = BREAKDOWN_PRECONDITIONER;
            if (!s.coarse && s.factors) ++s.fallbacks, s.fell = 1;
            if (!s.coarse) s.factors = 0;
            s.coarse = 0;
        }
        s.restart = 1;
    } else {
#ifdef ERRORS
        if (begins) error_of(a, island).of.looks = false;
        else if (ends_by_estimate(a, island, s, gamma, sum[4], peaks)) stop = CONVERGED;
#endif
        s.beta = s.restart ? 0 : gamma / s.gamma;
        const double pq = delta + s.beta * (sum[2] + sum[3]) + s.beta * s.beta * s.pq;
        const double qq = sum[7] + 2 * s.beta * sum[8] + s.beta * s.beta * s.qq, rq = sum[5] + s.beta * sum[6];
        if (stop == CONVERGED) {
            s.r2 = sum[4];  // of x as it is
        } else if (!begins && s.own_iterations == body.max_iterations) {
            stop = MAX_ITERATIONS;
        } else if (!(pq > 0)) {
            stop = BREAKDOWN_MATRIX;
        } else {
            s.own_iterations += !begins;
            s.alpha = gamma / pq;
            s.r2 = fmax(0.0, sum[4] - 2 * s.alpha * rq + s.alpha * s.alpha * qq);
            s.gamma = gamma;
            s.pq = pq;
            s.qq = qq;
            s.pending = 1;
            s.restart = begins;
            if (s.r2 <= s.goal2) stop = CONVERGED;
#ifdef ERRORS
            if (!begins) error_of(a, island).of.move(s.alpha, s.r2);
#endif
            if (s.choice.probe > 0 && s.own_iterations == s.choice.probe && !s.switched_after && !s.fell) {
                s.switched_after = s.own_iterations;
                s.residual_then = sqrt(s.r2 / s.start2);
                s.factors = !s.factors;
                s.restart = 1;
            }
        }
    }
    if (stop >= 0) {
        s.own_status = stop;
        s.stage = STANDS;
        atomicSub(&a.tally->iterating, 1);
    }
    a.state[island] = s;
}

// A thread has a node: z += Z c, A z += A Z c, and all sums of the iteration. The last thread block of an island makes its step.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_finish(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int body = here.body, island = island_of(a, body), i = here.begin + threadIdx.x;
    if (island < 0 || a.state[island].stage == STANDS) return;
    const bool coarse = a.state[island].coarse && a.coarse_well[island];
    double sum[CG_SUMS] = {};
#ifdef ERRORS
    double z2 = 0, change2 = 0;
#endif
    if (i < here.end) {
        double z[3], az[3], r[3], p[3], q[3];
        copy3(a.z, i, z);
        copy3(a.az, i, az);
        copy3(a.r, i, r);
        copy3(a.p, i, p);
        copy3(a.q, i, q);
        if (coarse) {
            if (a.mode[body] >= 0) {
                double c[MODES], arm[3], v[3];
                for (int k = 0; k < MODES; ++k) c[k] = a.coefficient[MODES * body + k];
                arm_of(a, body, i, arm);
                rigid_velocity(rotation_of(a, i), arm, c, v);
                for (int k = 0; k < 3; ++k) {
                    z[k] += v[k];
                    for (int l = 0; l < MODES; ++l) az[k] += a.modes[MODES * (3ll * i + k) + l] * c[l];
                }
            }
            double f[3] = {0, 0, 0}, out[3];
            each_entry(a, here.body, i, [&](int r, double weight, int) {
                double u[3] = {0, 0, 0}, w[3];
                for (int side = 0; side < (is_pair(a, r) ? 2 : 1); ++side) {
                    const int there = body_of_row(a, r, side);
                    if (a.mode[there] >= 0) see(a.row[r].lever + 4 * side, a.coefficient + MODES * there, u);
                }
                stiff(a.row[r].stiffness, u, w);
                for (int k = 0; k < 3; ++k) f[k] += weight * w[k];
            });
            rotated_back(rotation_of(a, i), f, out);
            for (int k = 0; k < 3; ++k) {
                az[k] += out[k];
                a.z[3ll * i + k] = z[k];
                a.az[3ll * i + k] = az[k];
            }
        }
        sum[0] = dot3(r, z);
        sum[1] = dot3(z, az);
        sum[2] = dot3(z, q);
        sum[3] = dot3(p, az);
        sum[4] = dot3(r, r);
        sum[5] = dot3(r, az);
        sum[6] = dot3(r, q);
        sum[7] = dot3(az, az);
        sum[8] = dot3(az, q);
#ifdef ERRORS
        z2 = dot3(z, z);
        change2 = change2_at(a, i);
#endif
    }
#ifdef ERRORS
    leave_peaks(a, z2, change2);
#endif
    sum_block(sum);
    if (threadIdx.x < CG_SUMS) __stcg(a.chunk_sums + (long long)CG_SUMS * blockIdx.x + threadIdx.x, pick(sum, threadIdx.x));
    __shared__ bool last;
    __threadfence();
    __syncthreads();
    if (threadIdx.x == 0) last = atomicAdd(a.finished_chunks + island, 1u) == a.state[island].chunks - 1u;
    __syncthreads();
    if (!last) return;
    __threadfence();
    if (threadIdx.x == 0) a.finished_chunks[island] = 0;
    next_step(a, island);
}

// --- after a solve ------------------------------------------------------------------------------------------------------------------

// A thread has a node: A dy without contacts, and the residual of the solve.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_residual(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    if (island < 0 || !solves(a.state[island].phase)) return;
    double sum[CG_SUMS] = {};
    if (i < here.end) {
        double product[3], contact[3] = {0, 0, 0}, x[3];
        copy3(a.solution_product, i, product);
        add_entries(a, here.body, i, contact, [](const IslandRow& row) { return row.force; });
        copy3(a.x, i, x);
        for (int k = 0; k < 3; ++k) {
            const long long at = 3ll * i + k;
            const double rest = a.r0[at] - product[k] - contact[k];
            a.r[at] = rest;
            sum[0] += rest * rest;
            sum[1] += x[k] * a.left[at];
            sum[2] += x[k] * product[k];
        }
    }
#ifdef ERRORS
    leave_peaks(a, 0, i < here.end ? change2_at(a, i) : 0);
#endif
    sum_block(sum);
    if (threadIdx.x < CG_SUMS) a.chunk_sums[(long long)CG_SUMS * blockIdx.x + threadIdx.x] = pick(sum, threadIdx.x);
}

// Part of the solution at which the function that the pass minimizes is least along it. Done by a whole thread block.
__device__ double search_along(const IslandArguments& a, int island, int bodies, double dot_left, double curvature) {
    const int *members = a.island + a.island_start[island], warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const double factor = a.c.force_coefficient / a.c.dx_dv;
    return minimum_along([&](double part) {
        double work[1] = {0};
        for (int m = warp; m < bodies; m += SEARCH_THREADS / 32) {
            const int rows = a.own_rows[members[m]], *list = own_list(a, members[m]);
            for (int k = lane; k < rows; k += 32) {
                const int r = list[k];
                const DeviceRow& row = a.c.row[r];
                double step[3], at[3];
                for (int n = 0; n < 3; ++n) {
                    step[n] = a.c.dx_dv * a.row[r].seen[n];
                    at[n] = row.s[n] + part * step[n];
                }
                const ContactForce f =
                    is_tie(a, r) ? force_of_tie(a.ties, r - a.ties.first, at) : contact_force(row_at(a.c, r), at, row.limit, false);
                work[0] += f.normal * dot3(a.c.normal + 3 * r, step) + dot3(f.traction, step);
            }
        }
        sum_block<SEARCH_THREADS>(work);
        return part * curvature - dot_left - factor * work[0];
    });
}

// A thread block has an island: how well its system is solved, and which part of the solution is taken.
extern "C" __global__ void __launch_bounds__(SEARCH_THREADS) island_search(const IslandArguments a) {
    const int island = blockIdx.x;
    if (island >= a.tally->islands) return;
    IslandState s = a.state[island];
    if (!solves(s.phase)) return;
    double sum[CG_SUMS];
    sum_island<SEARCH_THREADS>(a, island, a.chunk_sums, sum);
    s.pending = 0;
    s.phase = ISLAND_PASSED;
#ifdef ERRORS
    if (error_of(a, island).of.enough && sum[0] <= LOST_DIGITS * s.r2) s.goal2 = fmax(s.goal2, sum[0]);  // it is exact enough
#endif
    if (s.own_status == CONVERGED && sum[0] > s.goal2) {
        if (sum[0] < 0.25 * s.last_true2) {
            s.last_true2 = sum[0];
            s.r2 = sum[0];
            s.restart = 1;
            s.phase = ISLAND_GOES_ON;
        } else {
            s.own_status = MAX_ITERATIONS;  // rounding errors dominate
        }
    }
    if (s.phase == ISLAND_PASSED) {
        s.part = s.last ? 1 : search_along(a, island, s.bodies, sum[1], sum[2]);
        ++s.passes;
        s.iterations += s.own_iterations;
        s.status = s.own_status;
        s.solved = s.given2 > 0 ? sqrt(sum[0] / s.given2) : 0;
        s.set = 0;
        s.hold = 1;
        if (!isfinite(sum[0] + s.part)) {
            s.phase = ISLAND_LOST;
            s.status = NOT_FINITE;
        }
    }
#ifdef ERRORS
    const Peaks peaks = peaks_of<SEARCH_THREADS>(a, island);
#endif
    __syncthreads();
    if (threadIdx.x > 0) return;
    a.state[island] = s;
#ifdef ERRORS
    IslandError& error = error_of(a, island);
    error.told = error.of.told(sum[0], peaks.change);
    error.of.enough = error.of.looks = false;
#endif
    if (s.phase != ISLAND_PASSED || s.choice.factor_step == 0 || s.own_iterations == 0) return;
    const PassEnd end = {s.own_iterations, s.switched_after, s.fell, sqrt(sum[0] / s.start2), s.residual_then};
    end_pass(a.choice[a.island[a.island_start[island]]], s.choice, end, 0);
}

// A thread has a node: y += part dy, left accordingly. Of an island that has ended: where its path enters obstacles.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_advance(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    if (island < 0) return;
    const IslandState& s = a.state[island];
    if (s.phase == ISLAND_PASSED && i < here.end)
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) {
            a.c.y[k] = (real)((double)a.c.y[k] + s.part * a.x[k]);
            a.left[k] -= s.part * a.solution_product[k];
        }
    if (s.phase == ISLAND_LOST && i < here.end)
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) a.c.y[k] = (real)__longlong_as_double(0x7ff8000000000000ll);
    if (s.phase != ISLAND_ENDED) return;
    double sum[CG_SUMS] = {};
    if (i < here.end && gives_rows(s.rounds, s.passes, a.passes)) {
        const SurfaceNode n = SurfaceNode::at(a.c, i);
        double y[3];
        load3(a.c.y, i, y);
        if (n.pair >= 0) sum[0] = sweep(a.c, n, y);
    }
    sum_block(sum);
    if (threadIdx.x < CG_SUMS) a.chunk_sums[(long long)CG_SUMS * blockIdx.x + threadIdx.x] = pick(sum, threadIdx.x);
}

#ifdef FACE_ROWS
// A thread has a triangle: rows where the path of an island that has ended takes it into obstacles.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) sweep_island_faces(const IslandArguments a) {
    const int i = blockIdx.x * CONTACT_THREADS + threadIdx.x;
    if (i >= a.c.faces.start[a.bodies_count] - a.c.faces.start[0]) return;
    const int body = a.c.faces.body[i], island = island_of(a, body);
    if (island < 0 || a.state[island].phase != ISLAND_ENDED) return;
    if (!gives_rows(a.state[island].rounds, a.state[island].passes, a.passes)) return;
    if (sweep_face(a.c, body, a.c.faces.start[0] + i)) a.c.faces.entered[body] = 1;
}
#endif

// A thread block has an island: whether there is another pass. One that is over leaves its results with its bodies.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) island_settle(const IslandArguments a) {
    const int island = blockIdx.x;
    if (island >= a.tally->islands) return;
    IslandState s = a.state[island];
    if (s.phase == ISLAND_PASSED) {
        if (threadIdx.x == 0) a.state[island].phase = ISLAND_READY;
        return;
    }
    if (s.phase != ISLAND_ENDED && s.phase != ISLAND_LOST) return;
    double sum[CG_SUMS] = {};
    if (s.phase == ISLAND_ENDED) sum_island(a, island, a.chunk_sums, sum);
    if (FACES) {
        double entered[1] = {0};
        for (int m = threadIdx.x; m < s.bodies; m += CONTACT_THREADS) {
            int& of_body = a.c.faces.entered[a.island[a.island_start[island] + m]];
            entered[0] += of_body;
            of_body = 0;
        }
        sum_block(entered);
        sum[0] += entered[0];
    }
    if (sum[0] > 0) {
        ++s.rounds;
        s.phase = ISLAND_READY;
        s.set = s.last = s.hold = s.rested = 0;
        s.relist = 1;
    } else {
        s.phase = ISLAND_OVER;
        for (int m = threadIdx.x; m < s.bodies; m += CONTACT_THREADS) {
            const int k = a.island[a.island_start[island] + m];
            const PcgBody& body = a.bodies[k];
            const bool factor = s.factors && has_factor(body);
            PcgResult& result = a.c.results[(a.c.step[0] % a.c.capacity) * a.bodies_count + k];
            result = {s.solved, s.seconds, has_factor(body) ? body.factor_step : -1, s.iterations, s.status, factor ? CHOLESKY : BLOCK_JACOBI, body.kind,
                      s.fallbacks, -1, body.probe};
#ifdef ERRORS
            result.solve_error = error_of(a, island).told;
#endif
            a.c.state[k].residual = s.residual;
            a.c.state[k].passes = s.passes;
            a.c.state[k].rounds = s.rounds;
        }
    }
    __syncthreads();
    if (threadIdx.x > 0) return;
    a.state[island] = s;
    if (s.phase == ISLAND_OVER) atomicSub(&a.tally->active, 1);
}

// --- the end of a step --------------------------------------------------------------------------------------------------------------

// A thread has a node: adds contacts between bodies, as a factor is to know them, to its blocks of A. Blocks of nodes against obstacles
// are known.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) know_pairs(const IslandArguments a, real* values) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    if (island < 0 || i >= here.end) return;
    const local* R = rotation_of(a, i);
    const int first = a.start[i], last = first + a.count[i];
    for (int e = first; a.count[i] && e < last; ++e) {
        const int entry = a.entry[e], r = entry / CORNERS, corner = entry % CORNERS;
        const double* s = a.row[r].known;
        if (s[0] == 0 && s[3] == 0 && s[5] == 0) continue;
        const double S[9] = {s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5]};
        each_corner(a, r, [&](int node, double weight, int c) {
            if (is_other_side(a, r, c) != is_other_side(a, r, corner)) return;
            int k = a.row_start[i];
            while (k < a.row_start[i + 1] && a.columns[k] != node) ++k;
            if (k == a.row_start[i + 1]) return;
            const local* there = rotation_of(a, node);
            for (int j = 0; j < 3; ++j) {
                double column[3], out[3];
                for (int m = 0; m < 3; ++m)
                    column[m] = S[3 * m] * (double)there[j] + S[3 * m + 1] * (double)there[3 + j] + S[3 * m + 2] * (double)there[6 + j];
                rotated_back(R, column, out);
                for (int m = 0; m < 3; ++m) values[9ll * k + 3 * m + j] += (real)(a.t.weight[entry] * weight * out[m]);
            }
        });
    }
}

// Sums what a body's rows with others exert, for each of these, ascending; its contact with itself is none. Done by a whole thread block.
__device__ void tell_pairs(const IslandArguments& a, int body) {
    __shared__ int next;
    const long long slot = (a.c.step[0] % a.c.capacity) * a.bodies_count + body;
    const int pairs = a.pair_rows[body], *list = own_list(a, body) + a.own_rows[body] - pairs;
    int told = 0;
    for (int last = -1; pairs > 0; ++told) {
        __syncthreads();
        if (threadIdx.x == 0) next = a.bodies_count;
        __syncthreads();
        for (int k = threadIdx.x; k < pairs; k += CONTACT_THREADS) {
            const int r = list[k], other = HAS_OWN && a.t.obstacle[r] == body ? -1 : a.t.obstacle[r];
            if (other > last && __ldcg(a.t.force + r) > 0) atomicMin(&next, other);
        }
        __syncthreads();
        last = next;
        if (last == a.bodies_count) break;
        double sum[10] = {};  // normal force, force, torque, point
        for (int k = threadIdx.x; k < pairs; k += CONTACT_THREADS) {
            const int r = list[k];
            const double normal = __ldcg(a.t.force + r);
            if (a.t.obstacle[r] != last || !(normal > 0)) continue;
            double p[3] = {0, 0, 0}, f[3];  // of the body's own side, at the end of the step
            for (int corner = 0; corner < CORNERS && !is_other_side(a, r, corner); ++corner) {
                const int node = a.t.corner[CORNERS * r + corner];
                double y[3], u[3];
                load3(a.c.y, node, y);
                rotated(rotation_of(a, node), y, u);
                for (int m = 0; m < 3; ++m)
                    p[m] += a.t.weight[CORNERS * r + corner] *
                            ((double)a.c.x[3ll * node + m] + a.c.dx_dv * ((double)a.c.predictor[3ll * node + m] + u[m]));
            }
            sum[0] += normal;
            for (int m = 0; m < 3; ++m) {
                f[m] = normal * a.t.normal[3 * r + m] + __ldcg(a.t.traction + 3 * r + m);
                sum[1 + m] += f[m];
                sum[7 + m] += normal * p[m];
            }
            sum[4] += p[1] * f[2] - p[2] * f[1];
            sum[5] += p[2] * f[0] - p[0] * f[2];
            sum[6] += p[0] * f[1] - p[1] * f[0];
        }
        sum_block(sum);
        if (threadIdx.x > 0 || told >= a.most_told) continue;
        PairSum& to = a.told[slot * a.most_told + told];
        to.other = last;
        to.normal = sum[0];
        for (int m = 0; m < 3; ++m) {
            to.force[m] = sum[1 + m];
            to.torque[m] = sum[4 + m];
            to.point[m] = sum[7 + m];
        }
    }
    if (threadIdx.x == 0) a.told_count[slot] = told;
}

// A thread block has a body: keeps the forces of its rows with others for the next step, and tells them. After the last kernel that reads the old ones.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) keep_pairs(const IslandArguments a) {
    const int body = blockIdx.x;
    const bool well = a.c.results[(a.c.step[0] % a.c.capacity) * a.bodies_count + body].status != NOT_FINITE;
    auto keep = [&](int r) {
        const DeviceRow& row = a.c.row[r];
        const bool closed = well && a.t.obstacle[r] >= 0 && row.force.normal > 0;
        if (closed) {
            atomicAdd(a.c.pair_contacts + body, 1);
            atomicAdd(a.c.pair_contacts + a.t.obstacle[r], HAS_OWN && a.t.obstacle[r] == body ? 0 : 1);
        }
        const double before = a.t.force[r];
        a.t.force[r] = closed ? row.force.normal : 0;
        a.t.hardening[r] = lasting_hardening(a.t.hardening[r], before, a.t.force[r], a.t.stiffness[r], a.t.thickness[r]);
        for (int k = 0; k < 3; ++k) a.t.traction[3 * r + k] = closed ? row.force.traction[k] : 0;
    };
    each_touching_range(a, body, [&](int first, int last) {
        for (int r = first + threadIdx.x; r < last; r += CONTACT_THREADS) keep(r);
    });
    __syncthreads();
    tell_pairs(a, body);
}

// A thread has a node: rows between bodies that carry force, and their work, added to what its body has from obstacles.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) pair_work(const IslandArguments a) {
    const NodeChunk here = a.c.chunks[blockIdx.x];
    const int island = island_of(a, here.body), i = here.begin + threadIdx.x;
    double sum[2] = {0, 0};
    const bool well = !HAS_TIES || a.c.results[(a.c.step[0] % a.c.capacity) * a.bodies_count + here.body].status != NOT_FINITE;
    if (island >= 0 && well && i < here.end && a.c.free[i] != 0) {
        double s[3], y[3], u[3];
        load3(a.c.y, i, y);
        rotated(rotation_of(a, i), y, u);
        for (int k = 0; k < 3; ++k) s[k] = a.c.dx_dv * ((double)a.c.predictor[3ll * i + k] + u[k]);
        const int first = a.start[i], last = first + a.count[i];
        for (int e = first; a.count[i] && e < last; ++e) {
            const int entry = a.entry[e], r = entry / CORNERS;
            if (!is_tie(a, r) && !(a.t.force[r] > 0)) continue;
            double f[3];
            for (int k = 0; k < 3; ++k)
                f[k] = is_tie(a, r) ? a.c.row[r].force.traction[k] : a.t.force[r] * a.t.normal[3 * r + k] + a.t.traction[3 * r + k];
            sum[1] += a.t.weight[entry] * dot3(f, s);
        }
    }
    sum_block(sum);
    if (threadIdx.x == 0) a.c.pair_sums[blockIdx.x] = sum[1];
}
