// SPDX-License-Identifier: MIT
// Contact with obstacles on a GPU, beside the solver: forces and stiffness of rows, line search, sweep, and the end of a step
// (contact_state.cuh has the order; law: kernels/contact_law.cuh; input: backends/contact.py).
//
// A thread has a node; the last thread block of a body to finish adds the sums in a fixed order and makes the body's decision. Bodies that
// touch each other are solved by island.cu, all but the end of a step.
#include "device_contact.cuh"

// --- the first kernel of a step -----------------------------------------------------------------------------------------------------

// A thread block has a body: chooses the rows that count as closed in the first pass.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) begin_contact(const ContactArguments c) {
    __shared__ double least[CONTACT_THREADS];
    const int body = blockIdx.x;
    double earliest = NEVER;
    each_own_row(c, body, [&](int r) {
        if (c.entry[r] < earliest) earliest = c.entry[r];
    });
    least[threadIdx.x] = earliest;
    __syncthreads();
    for (int k = CONTACT_THREADS / 2; k; k /= 2) {
        if ((int)threadIdx.x < k && least[threadIdx.x + k] < least[threadIdx.x]) least[threadIdx.x] = least[threadIdx.x + k];
        __syncthreads();
    }
    earliest = least[0];
    double closed[1] = {0};
    each_own_row(c, body, [&](int r) {
        DeviceRow& row = c.row[r];
        begin_friction(c, r);
        row.in_set = c.force[r] > 0 || (c.entry[r] <= 1 && c.entry[r] <= earliest + FIRST);
        closed[0] += row.in_set;
    });
    sum_block(closed);
    const int rows = list_rows(c, body);
    if (threadIdx.x > 0) return;
    if (FACES) c.faces.entered[body] = 0;
    const double unknown = __longlong_as_double(0x7ff8000000000000ll);
    const bool grouped = c.island_of && c.island_of[body] >= 0;
    c.state[body] = {0, 0, 1, unknown, grouped ? OVER : closed[0] > 0 ? CHOOSE_START : WITHOUT, 0, 0, 1, 0, 0, rows};
    if (body == 0) *c.active = c.island_of ? *c.alone : c.count;
}

// --- forces -------------------------------------------------------------------------------------------------------------------------

// Before the solver: in CHOOSE_START b' = b + i H^T f at y and the size of the same at 0, for READY what a pass needs.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) contact_forces(const ContactArguments c) {
    const NodeChunk here = c.chunks[blockIdx.x];
    const int i = here.begin + threadIdx.x;
    const ContactState state = c.state[here.body];
    if (blockIdx.x == 0 && threadIdx.x == 0) *c.pool_counter = 0;
    if (state.phase == WITHOUT && i < here.end) {
        keep_block(c, SurfaceNode::at(c, i), here.body);
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) c.contact_b[k] = c.b[k];
    }
    if (state.phase != CHOOSE_START && state.phase != READY) return;
    double sum[CONTACT_SUMS] = {};
    if (i < here.end) {
        const bool starts = state.phase == CHOOSE_START;
        const SurfaceNode n = SurfaceNode::at(c, i);
        if (starts) keep_block(c, n, here.body);
        double b[3], y[3], f[3] = {0, 0, 0}, other[3] = {0, 0, 0}, S[9] = {};
        load3(c.b, i, b);
        load3(c.y, i, y);
        for (int k = 0; k < 3 && !starts; ++k) {
            if (state.alpha != 1) {
                const double from = c.start[3ll * i + k];
                c.y[3ll * i + k] = (real)(from + state.alpha * (y[k] - from));
                y[k] = c.y[3ll * i + k];
            }
            c.start[3ll * i + k] = (real)y[k];
        }
        for (int r = n.pair; n.pair >= 0 && r < n.pair + 2; ++r) {
            if (!used(c, r)) continue;
            const double none[3] = {0, 0, 0};
            double s[3];
            if (starts) {
                n.displacement(c, none, s);
                evaluate(c, r, s, false, true);
                n.add_force(c, r, c.row[r].force, other);
            }
            n.displacement(c, y, s);
            evaluate(c, r, s, state.hold, state.set, state.rested && state.passes == 0 && !starts);
            n.add_force(c, r, c.row[r].force, f);
            if (starts) continue;
            const ContactRow row = row_at(c, r);
            n.add_stiffness(c, row, c.row[r].force, c.row[r].dual, S);
            sum[2] += state.set && c.row[r].in_set != (int)contact_force(row, s, 0, false).closed;
        }
        double pull[3] = {0, 0, 0};  // of triangles, H^T S H y; at the start i H^T f at 0
        if (has_faces(c, n, here.body)) {
            add_face_impulses(c, n, f);
            add_face_pulls(c, n, starts ? other : pull);
        }
        for (int k = 0; k < 3; ++k) {
            double Sy = S[3 * k] * y[0] + S[3 * k + 1] * y[1] + S[3 * k + 2] * y[2];
            const double all = b[k] + (starts ? other[k] : f[k]);
            if (FACES) Sy += pull[k];
            c.contact_b[3ll * i + k] = (real)(b[k] + f[k] + Sy);
            sum[0] += all * all;
            sum[1] += b[k] * b[k];
        }
        if (has_faces(c, n, here.body) && !starts) add_face_blocks(c, n, S);
        if (n.pair >= 0 && !starts) {
            real *own = c.values + 9ll * c.place[i], *base = c.base + 9ll * (n.pair / 2);
            for (int k = 0; k < 9; ++k) own[k] = (real)((double)base[k] + S[k]);
        }
    }
    if (!sum_body(c, here, sum) || threadIdx.x > 0) return;
    if (FACES) sum[2] += c.faces.counted[here.body];
    ContactState& to = c.state[here.body];
    if (state.phase == CHOOSE_START) {
        to.zero2 = sum[0];
        return;
    }
    to.given2 = sum[1] > sum[0] ? sum[1] : sum[0];
    to.by_law = sum[2] == 0;
}

// --- after the solver ---------------------------------------------------------------------------------------------------------------

// Whether an obstacle is touched after a solve without contact: sum[0] rows that act, sum[1] nodes that enter.
__device__ void look_for_touch(const ContactArguments& c, const SurfaceNode& n, const double* y, double* sum) {
    double s[3];
    n.displacement(c, y, s);
    for (int r = n.pair; r < n.pair + 2; ++r) {
        if (!used(c, r)) continue;
        evaluate(c, r, s, false, false);
        sum[0] += c.row[r].force.closed || c.row[r].force.slip > 0;
    }
    sum[1] += sweep(c, n, y);
}

// Evaluates the law at the start that the solver chose. sum[0]: square of the residual with it, b - A y + i H^T f; sum[1], sum[2]: of
// b + i H^T f and b.
__device__ void evaluate_start(const ContactArguments& c, const SurfaceNode& n, int body, const double* y, bool zero, double* sum) {
    double product[3], b[3], s[3], f[3] = {0, 0, 0};
    load3(c.last, n.node, product);
    load3(c.b, n.node, b);
    if (n.pair >= 0) n.displacement(c, y, s);
    for (int r = n.pair; n.pair >= 0 && r < n.pair + 2; ++r) {
        if (!used(c, r)) continue;
        evaluate(c, r, s, false, false);
        n.add_force(c, r, c.row[r].force, f);
    }
    if (has_faces(c, n, body)) add_face_impulses(c, n, f);
    for (int k = 0; k < 3; ++k) {
        const double all = b[k] + f[k], left = zero ? all : all + product[k];
        sum[0] += left * left;
        sum[1] += all * all;
        sum[2] += b[k] * b[k];
    }
}

// Sums of the line search, with r and r' the residuals of the pass: sum[0] dy . (b - A y) = dy . (r - i H^T f),
// sum[1] dy . A dy = dy . (r - r' - H^T S H dy).
__device__ void project(const ContactArguments& c, const SurfaceNode& n, int body, const double* y, double* sum) {
    double from[3], before[3], after[3], f[3] = {0, 0, 0}, S[9] = {}, pull[3] = {0, 0, 0};
    load3(c.start, n.node, from);
    load3(c.first, n.node, before);
    load3(c.last, n.node, after);
    const double dy[3] = {y[0] - from[0], y[1] - from[1], y[2] - from[2]};
    if (n.pair >= 0) add_rows(c, n, f, S);
    if (has_faces(c, n, body)) {
        add_face_impulses(c, n, f);
        add_face_pulls(c, n, pull);
    }
    for (int k = 0; k < 3; ++k) {
        sum[0] += dy[k] * (before[k] - f[k]);
        double Sdy = S[3 * k] * dy[0] + S[3 * k + 1] * dy[1] + S[3 * k + 2] * dy[2];
        if (FACES) Sdy += pull[k];
        sum[1] += dy[k] * (before[k] - after[k] - Sdy);
    }
}

// Evaluates the law after the last pass. sum[0]: square of the residual with it, r' + i H^T (f' - f) + H^T S H dy;
// sum[1], sum[2]: of b + i H^T f' and b.
__device__ void evaluate_end(const ContactArguments& c, const SurfaceNode& n, int body, const double* y, double* sum) {
    double from[3], left[3], b[3], s[3], f[3] = {0, 0, 0}, now[3] = {0, 0, 0}, S[9] = {};
    load3(c.start, n.node, from);
    load3(c.last, n.node, left);
    load3(c.b, n.node, b);
    const double dy[3] = {y[0] - from[0], y[1] - from[1], y[2] - from[2]};
    if (n.pair >= 0) {
        add_rows(c, n, f, S);
        n.displacement(c, y, s);
    }
    for (int r = n.pair; n.pair >= 0 && r < n.pair + 2; ++r) {
        if (!used(c, r)) continue;
        evaluate(c, r, s, true, false);
        n.add_force(c, r, c.row[r].force, now);
    }
    if (has_faces(c, n, body)) {
        add_face_impulses(c, n, now);
        add_face_pulls(c, n, left);
    }
    for (int k = 0; k < 3; ++k) {
        const double r = left[k] + now[k] - f[k] + S[3 * k] * dy[0] + S[3 * k + 1] * dy[1] + S[3 * k + 2] * dy[2];
        sum[0] += r * r;
        sum[1] += (b[k] + now[k]) * (b[k] + now[k]);
        sum[2] += b[k] * b[k];
    }
}

// Part of the solution at which the function that the pass minimizes is least along it. Done by a whole thread block.
__device__ double search_along(const ContactArguments& c, int body, int rows, double dot_left, double curvature) {
    const int *list = list_of(c, body), nodes = rows - (FACES ? c.faces.rows[body] : 0);  // triangles have their steps
    for (int k = threadIdx.x; k < nodes; k += CONTACT_THREADS) {
        const SurfaceNode n = SurfaceNode::at(c, c.node[list[k]]);
        double from[3], y[3], u[3];
        load3(c.start, n.node, from);
        load3(c.y, n.node, y);
        const double dy[3] = {y[0] - from[0], y[1] - from[1], y[2] - from[2]};
        n.to_world(dy, u);
        for (int m = 0; m < 3; ++m) c.row[list[k]].step[m] = c.dx_dv * u[m];
    }
    const double factor = c.force_coefficient / c.dx_dv;
    return minimum_along([&](double alpha) {
        double work[1] = {0};
        for (int k = threadIdx.x; k < rows; k += CONTACT_THREADS) {
            const DeviceRow& row = c.row[list[k]];
            const double at[3] = {row.s[0] + alpha * row.step[0], row.s[1] + alpha * row.step[1], row.s[2] + alpha * row.step[2]};
            const ContactForce f = contact_force(row_at(c, list[k]), at, row.limit, false);
            work[0] += f.normal * dot3(c.normal + 3 * list[k], row.step) + dot3(f.traction, row.step);
        }
        sum_block(work);
        return alpha * curvature - dot_left - factor * work[0];
    });
}

// Decides what comes after a solve: the rows that count as closed, the part of the solution that is taken, another pass, or the end.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) contact_search(const ContactArguments c) {
    const NodeChunk here = c.chunks[blockIdx.x];
    ContactState state = c.state[here.body];
    const int phase = state.phase, i = here.begin + threadIdx.x;
    if (phase == OVER) return;
    const bool starts = phase == FROM_START || phase == FROM_ZERO;
    double sum[CONTACT_SUMS] = {};
    if (i < here.end && phase != LOST) {
        const SurfaceNode n = SurfaceNode::at(c, i);
        double y[3];
        load3(c.y, i, y);
        if (starts) evaluate_start(c, n, here.body, y, phase == FROM_ZERO, sum);
        if (phase == SOLVED && n.pair >= 0) look_for_touch(c, n, y, sum);
        if (phase == PASSED) project(c, n, here.body, y, sum);
        if (phase == LAST_PASSED) evaluate_end(c, n, here.body, y, sum);
        if (phase >= LAST_PASSED && n.pair >= 0 && gives_rows(state.rounds, state.passes, c.passes)) sum[3] += sweep(c, n, y);
    }
    if (!sum_body(c, here, sum)) return;
    if (FACES && phase == SOLVED) sum[0] += c.faces.counted[here.body];
    const bool entered = sum[phase == SOLVED ? 1 : 3] > 0 || (FACES && c.faces.entered[here.body]);
    bool again = phase != LOST;
    state.set = 0;
    if (starts) {  // rows that would be hit without the law need not count as closed where it holds
        const double given2 = sum[2] > sum[1] ? sum[2] : sum[1];
        state.set = !(sum[0] <= c.tolerance * c.tolerance * given2);
        state.rested = !state.set;
    } else if (phase == PASSED) {
        state.alpha = search_along(c, here.body, state.rows, sum[0], sum[1]);
    } else {
        state.alpha = 1;
        if (phase == LAST_PASSED) {
            const double given2 = sum[2] > sum[1] ? sum[2] : sum[1];
            state.residual = given2 > 0 ? sqrt(sum[0] / given2) : 0;
        }
        const double enough = tolerance_of(c.tolerance, state.rested, state.passes, c.passes);
        const bool changed = phase == LAST_PASSED && state.residual > enough;  // the last solve may have changed the law again
        if (phase != SOLVED && again && entered) {
            ++state.rounds;
            state.rested = 0;
        }
        again = again && (entered || changed || (phase == SOLVED && sum[0] > 0));
        if (again && entered) state.rows = list_rows(c, here.body);
    }
    state.hold = phase == PASSED;
    state.phase = again ? READY : OVER;
    if (FACES) __syncthreads();
    if (threadIdx.x > 0) return;
    if (FACES) c.faces.entered[here.body] = 0;
    c.state[here.body] = state;
    if (!again) atomicSub(c.active, 1);
}

// --- the end of a step --------------------------------------------------------------------------------------------------------------

// Keeps the forces of a node's rows for the next step: sum[0] rows that carry force, sum[1] their work.
__device__ void keep_forces(const ContactArguments& c, const SurfaceNode& n, bool well, double* sum) {
    double y[3], s[3];  // of a point that was set back too
    load3(c.y, n.node, y);
    n.displacement(c, y, s);
    for (int r = n.pair; r < n.pair + 2; ++r) {
        const DeviceRow& row = c.row[r];
        const bool closed = well && used(c, r) && row.force.normal > 0;
        double f[3];
        const double before = c.force[r];
        c.force[r] = closed ? row.force.normal : 0;
        c.hardening[r] = lasting_hardening(c.hardening[r], before, c.force[r], c.stiffness[r], c.thickness[r]);
        for (int k = 0; k < 3; ++k) {
            c.traction[3 * r + k] = closed ? row.force.traction[k] : 0;
            f[k] = c.force[r] * c.normal[3 * r + k] + c.traction[3 * r + k];
        }
        sum[0] += closed;
        if (closed) sum[1] += dot3(f, s);
    }
}

// Force and torque of a body on each obstacle, to the host. Done by a whole thread block.
__device__ void write_reactions(const ContactArguments& c, int body, int rows, long long slot) {
    const int* list = list_of(c, body);
    for (int o = 0; o < c.obstacle_count; ++o) {
        double sum[6] = {};
        for (int k = threadIdx.x; k < rows; k += CONTACT_THREADS) {
            const int r = list[k];
            const double normal = __ldcg(c.force + r);
            if (c.obstacle[r] != o || !(normal > 0)) continue;
            double f[3], arm[3];
            const bool face = is_face(c, r);
            if (face) place_on_face(c, r, arm);
            for (int m = 0; m < 3; ++m) {
                f[m] = normal * c.normal[3 * r + m] + __ldcg(c.traction + 3 * r + m);
                arm[m] = (face ? arm[m] : (double)c.x[3ll * c.node[r] + m]) + c.row[r].s[m] - c.obstacles.end[7 * o + m];
                sum[m] -= f[m];
            }
            sum[3] -= arm[1] * f[2] - arm[2] * f[1];
            sum[4] -= arm[2] * f[0] - arm[0] * f[2];
            sum[5] -= arm[0] * f[1] - arm[1] * f[0];
        }
        if (rows) sum_block(sum);
        double* to = c.reactions + 6 * ((slot * c.count + body) * c.obstacle_count + o);
        for (int m = 0; m < 6; ++m)
            if (threadIdx.x == m) to[m] = sum[m];
    }
}

// Keeps what springs and contacts add to the matrix of this step, as a copy for a factor has it.
__device__ void keep_for_factors(const ContactArguments& c, int i) {
    const long long step = c.step[0];
    if (c.spring) note_spring(c.springs[i], step, c.spring_scale * c.spring[i]);
    if (!c.blocks_then || c.pair[i] < 0) return;
    const long long site = c.pair[i] / 2, sites = c.body_start[c.count] / 2;
    for (int j = 0; j < 3; ++j)
        for (int k = j; k < 3; ++k) {
            const long long at = 9ll * site + 3 * j + k;
            c.blocks_then[6 * (step % HISTORY * sites + site) + upper(j, k)] = (float)((double)c.known[at] - (double)c.base[at]);
        }
}

// After all passes: holds points back, keeps forces, and writes what became of contact.
extern "C" __global__ void __launch_bounds__(CONTACT_THREADS) finish_contact(const ContactArguments c) {
    const NodeChunk here = c.chunks[blockIdx.x];
    const int body = here.body, i = here.begin + threadIdx.x;
    const ContactState state = c.state[body];
    const long long slot = c.step[0] % c.capacity;
    PcgResult& solve = c.results[slot * c.count + body];
    const bool well = solve.status != NOT_FINITE;
    double sum[CONTACT_SUMS] = {};
    if (i < here.end) {
        const SurfaceNode n = SurfaceNode::at(c, i);
        if (c.spring || c.blocks_then) keep_for_factors(c, i);
        if (n.pair >= 0) {
            if (well && !(FACES && is_held_back(c, state))) sum[2] += clip(c, n);  // else finish_faces has done so
            keep_forces(c, n, well, sum);
            for (int k = 0; k < 9; ++k) c.values[9ll * c.place[i] + k] = c.known[9ll * (n.pair / 2) + k];  // copies are made after the step
            if (has_faces(c, n, body)) give_links(c, n, c.faces.known);
        } else if (c.pair[i] >= 0) {  // of a fixed node
            for (int r = c.pair[i]; r < c.pair[i] + 2; ++r) c.force[r] = c.traction[3 * r] = c.traction[3 * r + 1] = c.traction[3 * r + 2] = 0;
        }
    }
    if (c.island_of && threadIdx.x == 0) sum[1] += c.pair_sums[blockIdx.x];
    if (!sum_body(c, here, sum)) return;
    if (FACES) {
        sum[0] += c.faces.sums[2 * body];
        sum[1] += c.faces.sums[2 * body + 1];
        sum[2] += c.faces.clipped[body];
    }
    const bool grouped = c.island_of && c.island_of[body] >= 0;  // its sweeps have not listed rows
    int rows = state.rows;
    if (grouped) {
        rows = list_rows(c, body);
        __syncthreads();  // threads read what others have listed
    }
    write_reactions(c, body, rows, slot);
    if (threadIdx.x > 0) return;
    if (c.island_of) sum[2] += c.pair_clipped[body];
    const int contacts = (int)sum[0] + (c.island_of ? c.pair_contacts[body] : 0);
    const double unknown = __longlong_as_double(0x7ff8000000000000ll);
    c.contact_results[slot * c.count + body] = {contacts || state.passes ? state.residual : unknown, contacts, state.passes, (int)sum[2]};
    solve.status = status_in_contact(solve.status, !(state.residual > c.tolerance), (int)sum[2]);
    const bool balanced = solve.status != CONTACT && sum[2] == 0;  // else the forces are more than what acted
    if (c.balance[body].phase != FROZEN && (balanced || sum[1] > 0)) c.balance[body].work += sum[1];
}
