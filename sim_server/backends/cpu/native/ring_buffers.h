// SPDX-License-Identifier: MIT
// What the loops of both devices share: records and frames in rings that another thread empties, pace, stop and pause.
#pragma once
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <ctime>

#include "energy_balance.cuh"
#include "kinds.h"

struct Record {
    int64_t step;          // steps completed
    int64_t factor_step;   // -1: no factor used
    double time;           // s, at the end of the step
    double residual;
    double assemble, solve, integrate, whole, late, begin;  // s; begin: steady clock
    double cpu;            // s of processor time of the thread, whole step
    double nonlinear;      // |b| at the end of the step over the first |b|; -1: not evaluated
    double kinetic, elastic, gravity, work, budget;  // J (kernels/energy_balance.cuh); elastic: NaN where it was not evaluated
    double stride;         // m
    int32_t body, iterations, status, kind, asked, fallbacks, bad_node, probe, linearizations, unused;
};

// b: Balance or Energy of the body (kernels/energy_balance.cuh).
template <class B> static inline void note_energy(Record& record, const B& b) {
    record.kinetic = b.kinetic;
    record.elastic = b.elastic;
    record.gravity = b.gravity;
    record.work = b.work;
    record.budget = b.budget;
    record.stride = b.stride;
    const bool rests = b.phase == FROZEN && !b.found;
    if (b.phase != WELL && (rests || record.status != NOT_FINITE)) record.status = RUNAWAY;
    if (!rests) return;
    record.factor_step = -1;  // there was nothing to solve
    record.kind = record.asked;
}

struct Rings {
    double dt;
    double start_time;
    std::atomic<int64_t> step;             // completed
    Record* records;
    int64_t record_capacity;
    std::atomic<int64_t> record_head, record_tail;
    double* frames;                        // (capacity, 2, nodes, 3): x, v
    int64_t* frame_steps;
    int64_t frame_capacity;
    std::atomic<int64_t> frame_every;      // 0: none; set from outside as viewers come and go
    std::atomic<int64_t> energy_every;     // likewise of steps whose elastic energy is evaluated
    std::atomic<int64_t> frame_head, frame_tail;
    std::atomic<int64_t> frames_dropped, records_dropped, late_steps;
    int32_t realtime;                      // keep pace with the wall clock
    int32_t patient;                       // wait for room in the rings instead of dropping (no deadline to miss)
    std::atomic<int32_t> stop, pause;
    double deadline;                       // steady clock, of the next step; 0: now
    double late;                           // s that the step began after its deadline
};

// Is the elastic energy after so many steps wanted?
static inline bool energy_due(const Rings& rings, int64_t step) {
    const int64_t every = rings.energy_every.load(std::memory_order_relaxed);
    return every > 0 && step % every == 0;
}

static inline double now() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

static inline double thread_time() {
    timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static inline void nap(double seconds) {
    timespec t{(time_t)seconds, (long)((seconds - std::floor(seconds)) * 1e9)};
    nanosleep(&t, nullptr);
}

// Room for the records of one step. A full ring: wait if nobody minds, doing `meanwhile`, else say no.
template <class Meanwhile>
static bool room_for_records(Rings& rings, int64_t count, Meanwhile meanwhile) {
    while (rings.record_head.load() - rings.record_tail.load(std::memory_order_acquire) > rings.record_capacity - count) {
        if (!rings.patient || rings.stop.load()) return false;
        meanwhile();
        nap(2e-4);
    }
    return true;
}

// Before a step: sleep while paused and until it is due. False if the loop is to stop. `meanwhile` is called before each nap and
// says whether it wants to be called again soon.
template <class Meanwhile>
static bool wait_until_due(Rings& rings, Meanwhile meanwhile) {
    while (rings.pause.load(std::memory_order_relaxed) && !rings.stop.load()) {
        meanwhile();
        nap(1e-3);
        rings.deadline = 0;
    }
    rings.late = 0;
    if (rings.realtime && !rings.stop.load()) {
        double t = now();
        if (rings.deadline == 0) rings.deadline = t;
        for (; t < rings.deadline && !rings.stop.load(); t = now()) {
            double left = rings.deadline - t;
            nap(meanwhile() && left > 2e-4 ? 2e-4 : left);
        }
        rings.late = t > rings.deadline ? t - rings.deadline : 0;  // also by a nap that lasted too long
        if (rings.late > rings.dt) { ++rings.late_steps; rings.deadline = t; }  // do not chase lost time
        rings.deadline += rings.dt;
    }
    return !rings.stop.load();
}
