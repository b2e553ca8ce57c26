// SPDX-License-Identifier: MIT
// The simulation loop. It runs the launches of a step, solves each body, and exchanges data with the rest of the server only
// through mailboxes: an atomic pointer or flag each, looked at between solves, never waited for. The caller (ctypes) has let
// go of Python's lock, so no Python code, network, worker or disk can delay a step.
#include <cstring>
#include <vector>

#include "central_difference.h"
#include "energy.h"
#include "euler_form.h"
#include "faces.h"
#include "halving.h"
#include "newton.h"
#include "newton_contact.h"
#include "pair_reactions.h"
#include "sizes.h"

static void take_mail(Launch& l, int64_t step) {
    if (Binding* next = l.mail.exchange(nullptr)) {
        l.binding = next;
        next->taken = step;
    }
}

static void copy_all(const Loop& loop, const Changes& changes) {
    for (int i = 0; i < changes.count; ++i) std::memcpy(changes.copies[i].target, changes.copies[i].source, changes.copies[i].bytes);
    if (!loop.spawn) return;
    run(*loop.spawn, loop.threads);
    for (int i = 0; i < loop.blocks_launches; ++i)
        loop.launch[loop.of_blocks[i]].binding->items = (loop.row_start[loop.nodes] - loop.nodes) / 2;
}

// Makes the changes of parameters that wait. What they add to the elastic energy of the present state counts as work.
static void take_changes(Loop& loop) {
    if (!loop.changes.load(std::memory_order_relaxed)) return;
    Changes* next = loop.changes.exchange(nullptr);
    if (!next) return;
    if (loop.energies && loop.energies->begun) {
        std::vector<double> before(loop.bodies);
        measure_elastic(loop);
        for (int i = 0; i < loop.bodies; ++i) before[i] = loop.energies->balance[i].elastic;
        copy_all(loop, *next);
        measure_elastic(loop);
        for (int i = 0; i < loop.bodies; ++i) add_work(loop.energies->balance[i], loop.energies->balance[i].elastic - before[i], before[i]);
    } else {
        copy_all(loop, *next);
    }
    if (loop.substeps) loop.substeps->state.since = ESTIMATE_EVERY;
    next->taken.store(loop.rings.step, std::memory_order_release);
}

// Linearizes, solves and tries until the search of every body is over; then y is the whole change of velocity. Bodies that take backward
// Euler have none.
static void search_all(Loop& loop) {
    double begin = now(), solving = 0;
    Newton& newton = *loop.newton;
    auto own = [&](int i) { return !loop.euler || is_made(loop, i); };
    auto launch = [&](int late, auto takes_part) {
        const double start = now();
        for (int i = 0; i < loop.before; ++i)
            if (!detects(loop, i) && newton.late[i] == late) run_for(loop, loop.launch[i], takes_part);
        return now() - start;
    };
    if (!newton.forces_seconds) newton.forces_seconds = newton.blocks_seconds = loop.assemble_seconds;
    for (int i = 0; i < loop.bodies; ++i) {
        loop.newton->search[i].phase = DONE;
        if (own(i)) begin_search(loop, i);
    }
    auto searching = [&](int i) { return loop.newton->search[i].phase != DONE; };
    for (bool left = true; left;) {
        double t = now();
        each_body(loop, [&](int i) { solve(loop, i); });
        solving += now() - t;
        newton.forces_seconds = launch(0, searching);
        each_body(loop, [&](int i) { judge(loop, i); });
        left = false;
        for (int i = 0; i < loop.bodies; ++i) left = left || searching(i);
        auto linearizes = [&](int i) { return newton.search[i].phase == SOLVE; };
        bool more = false;
        for (int i = 0; i < loop.bodies; ++i) more = more || linearizes(i);
        if (more) newton.blocks_seconds = launch(1, linearizes);
    }
    for (int i = 0; i < loop.bodies; ++i)
        if (own(i)) end_search(loop, i);
    loop.assemble_seconds += now() - begin - solving;
}

static void take_factor(Body& body) {
    if (const Factor* next = body.mail.exchange(nullptr)) body.factor = next;
}

// Takes the settings and then the factor of a step: a factor is posted before settings ask for it. Settings written later apply to
// the next step, so that the record has those that the step was made with.
static void take_orders(Body& body) {
    body.now = body.settings;
    take_factor(body);
}

constexpr int64_t COPIED = 4096;  // blocks, whose copy takes longer than to share it out

// Copies A of a body as a factor is to know it, with contacts. Where steps may be made by the factor alone it is that of the scheme,
// without contacts, but for bodies that touch something for long.
static void copy_matrix(const Loop& loop, const Body& body, double* target) {
    const int64_t begin = loop.row_start[body.first], end = loop.row_start[body.last];
    Team::run((int)std::min<int64_t>(loop.threads, 1 + (end - begin) / COPIED), [&](int k, int parts) {
        const int64_t first = (end - begin) * k / parts, last = (end - begin) * (k + 1) / parts;
        std::memcpy(target + 9 * first, loop.values + 9 * (begin + first), 9 * sizeof(double) * (last - first));
    });
    if (!loop.contact) return;
    const int index = (int)(&body - loop.body);
    const bool of_euler = loop.euler && copied_as_of_euler(loop, index);
    if (of_euler) as_of_euler(loop, index, target);
    if (of_euler || !loop.stages) add_contacts(loop, body, target);
}

static void copy_for_worker(Loop& loop, Body& body) {
    double* target = body.snapshot.load(std::memory_order_acquire);
    if (!target) return;
    const int64_t index = &body - loop.body;
    const bool assembled = loop.stages ? loop.stages->state[index].assembled : !loop.euler || loop.euler->assembled[index];
    if (body.ahead < 0 && !assembled) return;  // in the next step
    if (assembled) note_diagonal(body.correction.known, matrix_of(loop, body), loop.rings.step);
    if (body.ahead < 0) {
        copy_matrix(loop, body, target);
    } else {
        for (int64_t k = 3 * (int64_t)body.first; k < 3 * (int64_t)body.last; ++k)
            *target++ = loop.x[k] + body.ahead * loop.v[k];
    }
    body.snapshot.store(nullptr, std::memory_order_relaxed);
    body.snapshot_step.store(loop.rings.step, std::memory_order_release);
    wake(loop.rings);
}

static void write_frame(Loop& loop) {
    Rings& rings = loop.rings;
    const int64_t slot = begin_frame(rings, rings.frame_head.load(), rings.step, [] { return true; });
    if (slot < 0) return;
    const int64_t size = 3 * (int64_t)loop.nodes;
    double* frame = rings.frames + 2 * size * slot;
    std::memcpy(frame, loop.x, sizeof(double) * size);
    std::memcpy(frame + size, loop.v, sizeof(double) * size);
    if (loop.contact) {
        const int64_t poses = 7 * (int64_t)loop.contact->obstacle_count;
        std::memcpy(rings.frame_poses + poses * slot, loop.contact->obstacles.end, sizeof(double) * poses);
    }
    rings.frame_head.fetch_add(1, std::memory_order_release);
}

static int first_bad_node(const double* b, const Body& body) {
    for (int i = body.first; i < body.last; ++i)
        for (int k = 0; k < 3; ++k)
            if (!std::isfinite(b[3 * i + k])) return i - body.first;
    return -1;
}

// Runs the launches before the solve, but for those that detect contacts where that is done already.
template <class F> static void run_assembly(Loop& loop, F take_part) {
    for (int i = 0; i < loop.before; ++i) {
        if (detects(loop, i)) continue;
        take_mail(loop.launch[i], loop.rings.step);
        if (loop.stages || loop.euler) run_for(loop, loop.launch[i], take_part);
        else run(loop.launch[i], loop.threads);
    }
}

// Runs the launches of the first stage. A body whose factor stands alone has its right-hand side from the same launches in every
// step, also where A is wanted, too.
static void assemble_stage(Loop& loop, bool whole) {
    const Stages& stages = *loop.stages;
    auto needs_matrix = [&](int i) { return stages.state[i].assembled != 0; };
    auto alone = [&](int i) { return stages.state[i].form == FACTOR; };
    std::fill_n(stages.held_moves, loop.bodies, 0);
    for (int i = 0; i < loop.bodies; ++i) choose_form(loop, i, whole);
    run_assembly(loop, needs_matrix);
    for (int i = 0; i < stages.firsts; ++i) run_for(loop, loop.launch[stages.first[i]], alone);
    for (int i = 0; i < loop.bodies; ++i)
        if (needs_matrix(i) || alone(i)) note_changes(loop.body[i].correction, loop.rings.step, loop.body[i].steps == 0);
    check_corrections(loop);
}

// Runs the launches of the step of bodies that take that of the scheme, or of which a copy of A is wanted.
static void assemble_single(Loop& loop, bool whole) {
    EulerForm* e = loop.euler;
    for (int i = 0; e && i < loop.bodies; ++i) e->assembled[i] = whole || !e->takes[i] || copy_wanted(loop.body[i]);
    auto needs_matrix = [&](int i) { return !e || e->assembled[i]; };
    run_assembly(loop, needs_matrix);
    for (int i = 0; i < loop.bodies; ++i)
        if (needs_matrix(i)) note_changes(loop.body[i].correction, loop.rings.step, loop.body[i].steps == 0);
}

// Advances the history of materials to the positions at which the last step ended.
static void advance_history(Loop& loop) {
    if (loop.advanced == loop.rings.step) return;
    for (int k = 0; k < loop.histories; ++k) run(loop.launch[loop.history[k]], loop.threads);
    loop.advanced = loop.rings.step;
}

// whole: A of all bodies is wanted.
static void assemble(Loop* loop, bool whole) {
    double begin = now();
    Rings& rings = loop->rings;
    loop->cpu_begin = thread_time();
    take_changes(*loop);
    advance_history(*loop);
    loop->clock[0] = rings.start_time + rings.step * rings.dt;
    for (int i = 0; i < loop->bodies; ++i) {
        take_orders(loop->body[i]);
        loop->moving[i] = 0;
        if (loop->euler) loop->euler->takes[i] = 0;
    }
    if (loop->euler && loop->contact) detect_contacts(*loop);
    if (loop->substeps) begin_substeps(*loop);
    else if (loop->stages) assemble_stage(*loop, whole);
    else assemble_single(*loop, whole);
    if (loop->newton && loop->newton->moved)
        std::memcpy(loop->newton->moved, loop->newton->predictor, 3 * sizeof(double) * (int64_t)loop->nodes);
    if (loop->contact && !loop->euler) detect_other_rows(*loop);
    if (loop->contact && loop->contact->ties.count) TieRows(*loop).prepare();
    for (int i = 0; i < loop->bodies && loop->contact; ++i)  // what copies have
        if (!loop->stages || copied_as_of_euler(*loop, i)) note_touches(*loop, loop->body[i]);
    for (int i = 0; i < loop->bodies; ++i) copy_for_worker(*loop, loop->body[i]);
    loop->assemble_begin = begin;
    loop->assemble_seconds = now() - begin;
}

static void note_contact(Loop& loop, int index, int64_t slot) {
    const ContactReport& report = loop.contact->report[index];
    Record& record = loop.rings.records[slot];
    record.contacts = report.contacts;
    record.passes = report.passes;
    record.clipped = report.clipped;
    record.contact_residual = report.residual;
    const int64_t size = 6 * (int64_t)loop.contact->obstacle_count;
    double* target = loop.rings.reactions + 6 * loop.rings.reaction_count * slot;
    std::memcpy(target, loop.contact->reaction + size * index, sizeof(double) * size);
}

static void note_holders(const Loop& loop, int index, int64_t slot) {
    const int64_t held = 6 * (int64_t)loop.holders;
    double* end = loop.rings.reactions + 6 * loop.rings.reaction_count * (slot + 1);
    std::memcpy(end - held, loop.held_reaction + held * index, sizeof(double) * held);
}

static void note_readings(const Loop& loop, int index, int64_t slot) {
    double* target = loop.rings.readings + loop.rings.most_readings * slot;
    for (int k = loop.measured_first[index]; k < loop.measured_first[index + 1]; ++k) *target++ = *loop.measured[k];
}

// Reports what bodies exert on grabs and on each other after a step.
static void report_reactions(Loop& loop, int64_t step) {
    static thread_local std::vector<Reaction> found;
    found.clear();
    if (loop.touch) {
        const void* params = loop.touch->binding->params;
        found.resize(loop.react(params, step, nullptr));
        if (!found.empty()) found.resize(loop.react(params, step, found.data()));
    }
    if (loop.contact && loop.contact->pair_first >= 0) add_pair_reactions(loop, step, found);
    put_reactions(loop.rings, found.data(), (int64_t)found.size(), [] { return true; });
}

static void finish_step(Loop* loop) {
    Rings& rings = loop->rings;
    int64_t first = rings.record_head.load(), step = rings.step + 1;
    double entered = now();
    bool keep = room_for_records(rings, loop->bodies, [] { return true; });
    double waited = now() - entered;  // no part of the step
    const double begun = now() - loop->assemble_seconds;  // but for what it waited for: room, and a factor
    for (int i = 0; i < loop->bodies; ++i) {
        SolveSettings& now = loop->body[i].now;
        now.deadline = now.step_budget > 0 ? begun + now.step_budget : 0;
    }
    if (loop->halving) remember_start(*loop);
    if (loop->substeps) make_substeps(*loop);
    if (loop->euler) make_step(*loop);
    else if (loop->newton && loop->contact) search_in_contact(*loop);
    else if (loop->newton) search_all(*loop);
    else if (loop->contact) solve_in_contact(*loop);
    each_body(*loop, [&](int i) {
        Body& body = loop->body[i];
        const SolveSettings& settings = body.now;
        int linearizations = 1;
        double nonlinear = -1, step_error = NAN;
        SolveResult r;
        if (loop->newton && (!loop->euler || is_made(*loop, i))) {
            r = as_solve_result(loop->newton->search[i]);
            r.at_rest = !loop->moving[i] && r.status == CONVERGED && r.iterations == 0;
            linearizations = std::max(1, loop->newton->search[i].linearizations);
            nonlinear = residual_ratio(loop->newton->search[i]);
            step_error = loop->newton->search[i].step_error;
        } else if (loop->substeps) {
            r = loop->substeps->result[i];
        } else if (loop->euler) {
            r = step_result(*loop, i);
        } else if (loop->contact) {
            r = loop->contact->result[i];
        } else {
            const BlockCsr A = matrix_of(*loop, body);
            r = pcg(A, loop->b + 3 * body.first, body.factor, settings, loop->y + 3 * body.first,
                    loop->work + WORK * (int64_t)body.first, !loop->moving[i], &body.correction);
        }
        ++body.steps;
        if (!keep) return;
        Record& record = rings.records[(first + i) % rings.record_capacity];
        bool used = body.factor && (settings.kind == CHOLESKY || r.kind == CHOLESKY || r.fallbacks);
        record = make_record(rings, step, i, r);
        if (used) record.factor_step = body.factor->step;
        record.assemble = loop->assemble_seconds;
        record.late = rings.late;
        record.begin = loop->assemble_begin;
        record.nonlinear = nonlinear;
        record.asked = settings.kind;
        record.bad_node = r.status != NOT_FINITE ? -1 : first_bad_node(loop->substeps ? loop->substeps->force : loop->b, body);
        record.probe = settings.probe;
        record.linearizations = linearizations;
        record.solve_error = r.solve_error;
        record.step_error = step_error;
        if (loop->contact) note_contact(*loop, i, (first + i) % rings.record_capacity);
        if (loop->substeps) note_substeps(*loop->substeps, i, record);
        if (loop->euler && loop->euler->takes[i]) record.form = EULER;
        if (!loop->stages) return;
        record.form = loop->stages->state[i].form;
        record.estimate = loop->stages->state[i].estimate;
    });
    double solved = now();
    for (int i = loop->before; i < loop->launches && !loop->euler; ++i) run(loop->launch[i], loop->threads);
    if (loop->halving) halve_steps(*loop);
    if (loop->energies) account(*loop, energy_due(rings, step));
    double end = now(), cpu = thread_time() - loop->cpu_begin;
    ++rings.step;
    if (!keep) { rings.records_dropped += loop->bodies; }
    else {
        for (int i = 0; i < loop->bodies; ++i) {
            Record& record = rings.records[(first + i) % rings.record_capacity];
            record.integrate = end - solved;
            record.whole = end - loop->assemble_begin - waited;  // with a factorization that the step waited for
            record.cpu = cpu;
            if (loop->halving) note_halving(*loop->halving, i, record);
            if (loop->energies) note_energy(record, loop->energies->balance[i]);
            if (loop->holders) note_holders(*loop, i, (first + i) % rings.record_capacity);
            if (loop->measured) note_readings(*loop, i, (first + i) % rings.record_capacity);
        }
        report_reactions(*loop, step);
        rings.record_head.store(first + loop->bodies, std::memory_order_release);
    }
    write_frame(*loop);
}

// Parameters that change before the first step are those that it begins with.
static void begin_energies(Loop& loop) {
    if (!loop.energies) return;
    if (!loop.energies->begun) take_changes(loop);
    enter(loop);
}

extern "C" {

void wf_assemble(Loop* loop) {
    begin_energies(*loop);
    assemble(loop, true);
}

// A factor posted since `wf_assemble` is made from the matrix of this step, or the caller does not mind; likewise settings.
void wf_solve(Loop* loop) {
    for (int i = 0; i < loop->bodies; ++i) {
        take_orders(loop->body[i]);
        if (!loop->stages) continue;
        choose_form(*loop, i, true);
    }
    if (loop->stages) check_corrections(*loop);
    finish_step(loop);
    if (loop->energies) leave(*loop);
}

// Has the loop know of what matrix a factor will be made.
void wf_note_matrix(Loop* loop, int32_t body) {
    note_diagonal(loop->body[body].correction.known, matrix_of(*loop, loop->body[body]), loop->rings.step);
}
void wf_copy_matrix(Loop* loop, int32_t body, double* target) { copy_matrix(*loop, loop->body[body], target); }
int32_t wf_wait(Loop* loop) { return wait_until_due(loop->rings, [] { return false; }); }

// Runs until `steps` are done or `stop` is set; returns the steps done.
int64_t wf_run(Loop* loop, int64_t steps) {
    int64_t done = 0;
    begin_energies(*loop);
    for (; done < steps && wf_wait(loop); ++done) {
        assemble(loop, false);
        finish_step(loop);
    }
    if (loop->energies) leave(*loop);
    return done;
}

// Begins the energy balances of bodies that were put back to their start, also of frozen ones.
void wf_restart(Loop* loop, const int32_t* bodies, int32_t count) {
    if (!loop->energies) return;
    measure_elastic(*loop);
    for (int k = 0; k < count; ++k) {
        loop->energies->balance[bodies[k]].phase = WELL;
        begin_balance(*loop, loop->body[bodies[k]], loop->energies->balance[bodies[k]]);
    }
}

const Factor* wf_post_factor(Body* body, const Factor* factor) { return body->mail.exchange(factor); }
void wf_take_changes(Loop* loop) { take_changes(*loop); }
Changes* wf_post_changes(Loop* loop, Changes* changes) { return loop->changes.exchange(changes); }
Binding* wf_post_binding(Launch* launch, Binding* binding) { return launch->mail.exchange(binding); }

// One application of a factor, z = P^-1 r. A probe for tests and benchmarks.
void wf_apply_factor(const Factor* factor, const double* r, double* z, double* work, int32_t threads) {
    auto apply = [&](auto* values, auto* room) {
        using T = std::remove_pointer_t<decltype(room)>;
        if (FactorPlan* plan = factor->pattern->plan) apply_factor(*plan, values, r, 1, z, threads, true, [](T*) {});
        else apply_factor(*factor->pattern, values, r, 1, z, room);
    };
    if (factor->bytes == 4) apply((const float*)factor->values, (float*)work);
    else apply((const double*)factor->values, work);
}

// How `threads` share the solves of factors of a pattern; null where they cannot (factor_plan.h) or without memory.
FactorPlan* wf_plan(const Pattern* pattern, int32_t threads) {
    try {
        auto plan = std::make_unique<FactorPlan>(*pattern, threads);
        return plan->make() ? plan.release() : nullptr;
    } catch (const std::bad_alloc&) {
        return nullptr;
    }
}
void wf_delete_plan(FactorPlan* plan) { delete plan; }

// The same of what a solve of a body with its factor would use now, corrected for changes of the diagonal. A probe for tests.
// work: 2 n doubles.
void wf_precondition(Loop* loop, int32_t index, const double* r, double* z, double* work) {
    Body& body = loop->body[index];
    take_factor(body);
    const BlockCsr A = matrix_of(*loop, body);
    Preconditioner P{A, body.factor, CHOLESKY, nullptr, work, 1, &body.correction};
    P.prepare();
    P.apply(r, std::sqrt(dot(A.size(), r, r)), z);
}

const StructSize* wf_sizes() {
    static const StructSize sizes[] = {SIZE(Launch), SIZE(Body), SIZE(Loop), SIZE(Factor), SIZE(KnownContact), SIZE(Pattern), SIZE(Record),
                                       SIZE(Newton), SIZE(Search), SIZE(Stages), SIZE(StageState), SIZE(EulerForm), SIZE(Elastic), SIZE(Energies), SIZE(Balance),
                                       SIZE(Contact), SIZE(RowState), SIZE(PassChoice), SIZE(OwnReference), SIZE(ContactReport), SIZE(Box), SIZE(Reaction), SIZE(CentralDifference), SIZE(Halving), SIZE(ShortSteps), SIZE(StableStep), SIZE(Copy), SIZE(Changes), {}};
    return sizes;
}
}
