// SPDX-License-Identifier: MIT
// The simulation loop. It runs the launches of a step, solves each body, and exchanges data with the rest of the server only
// through mailboxes: an atomic pointer or flag each, looked at between solves, never waited for. The caller (ctypes) has let
// go of Python's lock, so no Python code, network, worker or disk can delay a step.
#include <cstring>

#include "pcg.h"

typedef void (*Kernel)(const void* params, int begin, int end);

struct Binding {           // arguments of a launch, replaceable between steps
    const void* params;
    int32_t items;
    int32_t unused;
    int64_t taken;   // steps completed when the loop took it up, -1: it has not
};

struct Launch {
    Kernel kernel;
    Binding* binding;
    std::atomic<Binding*> mail;   // the next one, or null
};

struct Body {
    int32_t first, last;                // nodes
    SolveSettings settings;
    const Factor* factor;               // in use
    std::atomic<const Factor*> mail;    // a newer one, or null
    std::atomic<double*> snapshot;      // where to copy the values of A, or the positions, or null
    std::atomic<int64_t> snapshot_step; // step of the last copy made, -1: none
    double ahead;                       // s: below 0 the copy is of A, else of x + ahead v
    int64_t steps;                      // solved so far
};

struct Loop {
    int32_t launches, before;          // launches; how many of them assemble (the others integrate)
    Launch* launch;
    int32_t bodies, nodes;
    Body* body;
    const int32_t* row_start;
    const int32_t* columns;
    const double* values;
    const double* b;                   // (nodes, 3) right-hand side in the material frame
    double* y;                         // (nodes, 3) start in, solution out
    double* x;                         // (nodes, 3) for frames
    double* v;
    double* work;                      // 45 doubles a node
    double* clock;                     // (1,) s, read by kernels
    int32_t threads;                   // of this process, for launches and bodies
    int32_t unused;
    double assemble_begin;
    double assemble_seconds;
    double cpu_begin;
    Rings rings;
};

static void run(Launch& l, int threads, int64_t step) {
    if (Binding* next = l.mail.exchange(nullptr)) {
        l.binding = next;
        next->taken = step;
    }
    const int64_t items = l.binding->items, grain = 512;
    int parts = (int)(items / grain < threads ? items / grain : threads);
    if (parts < 2) {
        if (items > 0) l.kernel(l.binding->params, 0, (int)items);
        return;
    }
#pragma omp parallel for num_threads(parts) schedule(static, 1)
    for (int k = 0; k < parts; ++k) l.kernel(l.binding->params, (int)(items * k / parts), (int)(items * (k + 1) / parts));
}

static void copy_for_worker(Loop& loop, Body& body) {
    double* target = body.snapshot.load(std::memory_order_acquire);
    if (!target) return;
    if (body.ahead < 0) {
        int64_t begin = loop.row_start[body.first], end = loop.row_start[body.last];
        std::memcpy(target, loop.values + 9 * begin, 9 * sizeof(double) * (end - begin));
    } else {
        for (int64_t k = 3 * (int64_t)body.first; k < 3 * (int64_t)body.last; ++k)
            *target++ = loop.x[k] + body.ahead * loop.v[k];
    }
    body.snapshot.store(nullptr, std::memory_order_relaxed);
    body.snapshot_step.store(loop.rings.step, std::memory_order_release);
}

static bool room_for_frame(Rings& rings) {
    while (rings.frame_head.load() - rings.frame_tail.load(std::memory_order_acquire) >= rings.frame_capacity) {
        if (!rings.patient || rings.stop.load()) return false;
        nap(2e-4);
    }
    return true;
}

static void write_frame(Loop& loop) {
    Rings& rings = loop.rings;
    const int64_t every = rings.frame_every.load();  // once: it may become 0 meanwhile
    if (every <= 0 || rings.step % every) return;
    if (!room_for_frame(rings)) { ++rings.frames_dropped; return; }
    int64_t slot = rings.frame_head.load() % rings.frame_capacity, size = 3 * (int64_t)loop.nodes;
    double* frame = rings.frames + 2 * size * slot;
    std::memcpy(frame, loop.x, sizeof(double) * size);
    std::memcpy(frame + size, loop.v, sizeof(double) * size);
    rings.frame_steps[slot] = rings.step;
    rings.frame_head.fetch_add(1, std::memory_order_release);
}

static int first_bad_node(const Loop& loop, const Body& body) {
    for (int i = body.first; i < body.last; ++i)
        for (int k = 0; k < 3; ++k)
            if (!std::isfinite(loop.b[3 * i + k])) return i - body.first;
    return -1;
}

extern "C" {

void wf_assemble(Loop* loop) {
    double begin = now();
    Rings& rings = loop->rings;
    loop->cpu_begin = thread_time();
    loop->clock[0] = rings.start_time + rings.step * rings.dt;
    for (int i = 0; i < loop->before; ++i) run(loop->launch[i], loop->threads, rings.step);
    for (int i = 0; i < loop->bodies; ++i) copy_for_worker(*loop, loop->body[i]);
    loop->assemble_begin = begin;
    loop->assemble_seconds = now() - begin;
}

void wf_solve(Loop* loop) {
    Rings& rings = loop->rings;
    int64_t first = rings.record_head.load(), step = rings.step + 1;
    double entered = now();
    bool keep = room_for_records(rings, loop->bodies, [] {});
    double waited = now() - entered;  // no part of the step
#pragma omp parallel for num_threads(loop->threads) schedule(dynamic, 1) if (loop->threads > 1 && loop->bodies > 1)
    for (int i = 0; i < loop->bodies; ++i) {
        Body& body = loop->body[i];
        if (const Factor* next = body.mail.exchange(nullptr)) body.factor = next;
        BlockCsr A{body.first, body.last, loop->row_start, loop->columns, loop->values};
        const SolveSettings settings = body.settings;  // they may change meanwhile
        SolveResult r = pcg(A, loop->b + 3 * body.first, body.factor, settings, loop->y + 3 * body.first,
                            loop->work + 45 * (int64_t)body.first);
        ++body.steps;
        if (!keep) continue;
        Record& record = rings.records[(first + i) % rings.record_capacity];
        bool used = body.factor && (settings.kind == CHOLESKY || r.kind == CHOLESKY || r.fallbacks);
        record = Record{step, used ? body.factor->step : -1, rings.start_time + step * rings.dt, r.residual,
                        loop->assemble_seconds, r.seconds, 0, 0, rings.late, loop->assemble_begin, 0, i, r.iterations, r.status,
                        r.kind, settings.kind, r.fallbacks, r.status == NOT_FINITE ? first_bad_node(*loop, body) : -1, settings.probe};
    }
    double solved = now();
    for (int i = loop->before; i < loop->launches; ++i) run(loop->launch[i], loop->threads, rings.step);
    double end = now(), cpu = thread_time() - loop->cpu_begin;
    ++rings.step;
    if (!keep) { rings.records_dropped += loop->bodies; }
    else {
        for (int i = 0; i < loop->bodies; ++i) {
            Record& record = rings.records[(first + i) % rings.record_capacity];
            record.integrate = end - solved;
            record.whole = end - loop->assemble_begin - waited;  // with a factorization that the step waited for
            record.cpu = cpu;
        }
        rings.record_head.store(first + loop->bodies, std::memory_order_release);
    }
    write_frame(*loop);
}

int32_t wf_wait(Loop* loop) { return wait_until_due(loop->rings, [] { return false; }); }

// Runs until `steps` are done or `stop` is set; returns the steps done.
int64_t wf_run(Loop* loop, int64_t steps) {
    int64_t done = 0;
    for (; done < steps && wf_wait(loop); ++done) {
        wf_assemble(loop);
        wf_solve(loop);
    }
    return done;
}

const Factor* wf_post_factor(Body* body, const Factor* factor) { return body->mail.exchange(factor); }
Binding* wf_post_binding(Launch* launch, Binding* binding) { return launch->mail.exchange(binding); }

// One application of a factor, for tests and measurements: z = P^-1 r.
void wf_apply_factor(const Factor* factor, const double* r, double* z, double* work) {
    if (factor->bytes == 4) apply_factor(*factor->pattern, (const float*)factor->values, r, 1, z, (float*)work);
    else apply_factor(*factor->pattern, (const double*)factor->values, r, 1, z, work);
}

int32_t wf_sizes(int32_t* sizes) {  // layouts, checked against the Python side
    sizes[0] = sizeof(Launch); sizes[1] = sizeof(Body); sizes[2] = sizeof(Loop); sizes[3] = sizeof(Factor);
    sizes[4] = sizeof(Pattern); sizes[5] = sizeof(Record);
    return 6;
}
}
