// SPDX-License-Identifier: MIT
// What the loops of both devices share: records and frames in rings that another thread empties, pace, stop and pause.
#pragma once
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <ctime>

#include "reaction.h"
#include "step_record.cuh"

struct Rings {
    double dt;
    double start_time;
    std::atomic<int64_t> step;             // completed
    Record* records;
    int64_t record_capacity;
    double* reactions;                     // (record_capacity, reaction_count, 6) of each record
    int64_t reaction_count;                // obstacles, and then holders
    double* readings;                      // (record_capacity, most_readings) of the body of each record, or null
    int64_t most_readings;                 // of a body
    std::atomic<int64_t> record_head, record_tail;
    Reaction* others;                      // (other_capacity,) on grabs and other bodies, in the order of steps; there before the step's records
    int64_t other_capacity;
    std::atomic<int64_t> other_head, other_tail, others_dropped;
    double* frames;                        // (capacity, 2, nodes, 3): x, v
    double* frame_poses;                   // (frame_capacity, obstacles, 7) where obstacles are in each; null: no contact
    int64_t* frame_steps;
    int64_t frame_capacity;
    std::atomic<int64_t> frame_every;      // 0: none; set from outside as viewers come and go
    std::atomic<int64_t> energy_every;     // likewise of steps whose elastic energy is evaluated
    std::atomic<int64_t> frame_head, frame_tail;
    std::atomic<int64_t> frames_dropped, records_dropped, late_steps;
    int32_t realtime;                      // keep pace with the wall clock
    int32_t patient;                       // wait for room in the rings instead of dropping (no deadline to miss)
    std::atomic<int32_t> wake;             // eventfd that is written when a matrix that was asked for is there; 0: none
    std::atomic<int32_t> stop;
    std::atomic<int32_t> pause, halted;    // number of a pause, 0: none; the pause in which the loop stands still, 0: it does not
    std::atomic<int64_t> single;           // steps that the loop is to make while it is paused
    std::atomic<int64_t> hold, held;       // number of a request to stand still between two steps, 0: none; the last one that it has followed
    double deadline;                       // steady clock, of the next step; 0: now
    double late;                           // s that the step began after its deadline
};

// Whether the frame after `step` steps is wanted.
static inline bool frame_due(const Rings& rings, int64_t step) {
    const int64_t every = rings.frame_every.load(std::memory_order_relaxed);  // once: it may become 0 meanwhile
    return every > 0 && step % every == 0;
}

// Whether the elastic energy after `step` steps is wanted.
static inline bool energy_due(const Rings& rings, int64_t step) {
    const int64_t every = rings.energy_every.load(std::memory_order_relaxed);
    return every > 0 && step % every == 0;
}

// Wakes who waits for a matrix.
static inline void wake(const Rings& rings) {
    const uint64_t one = 1;
    const int32_t fd = rings.wake.load(std::memory_order_relaxed);
    if (fd && write(fd, &one, sizeof one) < 0) return;  // full: it is awake
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

// The record of a body after `step` steps, of a solve with the members of SolveResult (pcg.h). The rest is filled in by name.
template <class Solve>
static inline Record make_record(const Rings& rings, int64_t step, int32_t body, const Solve& solve) {
    Record record;
    record.step = step;
    record.time = rings.start_time + step * rings.dt;
    record.body = body;
    note_solve(record, solve);
    return record;
}

// Whether a ring filled up to `head` has room for `count` more. If it is full: in patient mode block, calling `meanwhile`, until it
// has (false only if that returns false, or on stop); otherwise return false at once.
template <class Meanwhile>
static bool has_room(const Rings& rings, int64_t head, const std::atomic<int64_t>& tail, int64_t capacity, int64_t count, Meanwhile meanwhile) {
    while (head - tail.load(std::memory_order_acquire) > capacity - count) {
        if (!rings.patient || rings.stop.load() || !meanwhile()) return false;
        nap(1e-4);
    }
    return true;
}

// Room for the records of one step.
template <class Meanwhile>
static bool room_for_records(const Rings& rings, int64_t count, Meanwhile meanwhile) {
    return has_room(rings, rings.record_head.load(), rings.record_tail, rings.record_capacity, count, meanwhile);
}

// Puts the reactions of a step into their ring; counts them as dropped where it is full.
template <class Meanwhile>
static void put_reactions(Rings& rings, const Reaction* found, int64_t count, Meanwhile meanwhile) {
    const int64_t head = rings.other_head.load();
    if (!count) return;
    if (count > rings.other_capacity || !has_room(rings, head, rings.other_tail, rings.other_capacity, count, meanwhile)) {
        rings.others_dropped += count;
        return;
    }
    for (int64_t k = 0; k < count; ++k) rings.others[(head + k) % rings.other_capacity] = found[k];
    rings.other_head.store(head + count, std::memory_order_release);
}

// Slot of the ring that the frame after `step` steps goes to, where `head` frames came before it; -1: none is wanted, or it is
// dropped as there is no room.
template <class Meanwhile>
static int64_t begin_frame(Rings& rings, int64_t head, int64_t step, Meanwhile meanwhile) {
    if (!frame_due(rings, step)) return -1;
    if (!has_room(rings, head, rings.frame_tail, rings.frame_capacity, 1, meanwhile)) { ++rings.frames_dropped; return -1; }
    rings.frame_steps[head % rings.frame_capacity] = step;
    return head % rings.frame_capacity;
}

enum Due { DUE_STOP, DUE_NEXT, DUE_SINGLE };  // no step, one of a run, one of those that are made in a pause (base.py)

// Before a step: stand still on request, sleep while paused and until it is due. `meanwhile` is called
// before each nap and says whether it wants to be called again soon. A request to stand still is followed once nothing is under way;
// what it changes may make the next step late, which the record tells.
template <class Meanwhile>
static Due wait_until_due(Rings& rings, Meanwhile meanwhile) {
    while (!rings.stop.load()) {
        const int64_t request = rings.hold.load();
        const int32_t pause = rings.single.load() <= 0 ? rings.pause.load() : 0;
        if (!request && !pause) break;
        meanwhile();
        if (request) rings.held.store(request);
        if (pause) {
            rings.deadline = 0;
            rings.halted.store(pause);
        }
        nap(request ? 1e-4 : 1e-3);
    }
    rings.halted.store(0);  // before `single` says that no step is left
    const bool single = rings.pause.load() && rings.single.load() > 0;
    if (single) rings.single.fetch_sub(1);
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
    return rings.stop.load() ? DUE_STOP : single ? DUE_SINGLE : DUE_NEXT;
}
