// SPDX-License-Identifier: MIT
// Memory of the GPU loop (loop.cpp), and its calls of the driver. loop.py holds the same layouts.
#pragma once
#include <cstdio>
#include <cstring>

#include "../cpu/native/ring_buffers.h"
#include "energy_record.cuh"

typedef uint64_t Address;       // on the device

struct Cuda {                   // functions of the driver; each returns 0 or an error
    int32_t (*context_set)(void* context);
    int32_t (*graph_launch)(void* graph, void* stream);
    int32_t (*to_device)(Address to, const void* from, size_t bytes, void* stream);
    int32_t (*to_host)(void* to, Address from, size_t bytes, void* stream);
    int32_t (*on_device)(Address to, Address from, size_t bytes, void* stream);
    int32_t (*event_record)(void* event, void* stream);
    int32_t (*event_query)(void* event);
    int32_t (*event_wait)(void* event);
    int32_t (*stream_wait)(void* stream, void* event, uint32_t flags);
};
static const int32_t NOT_READY = 600;

struct Mail {
    const void* bytes;
    void* event;                // null, or what must be done before they are used
    int64_t number;
    std::atomic<int64_t> taken;     // steps launched before it went to the device: it holds for those after; -1: it has not
};

struct Mailbox {                // bytes on the device that are replaced between batches
    Address target;
    int64_t size;
    std::atomic<Mail*> mail;
    Mail* held;                 // taken out, its event not done yet
    std::atomic<int64_t> taken; // number of the last one that went to the device
};

struct Result {                 // pcg_structs.cuh
    double residual, seconds;
    int64_t factor_step;
    int32_t iterations, status, kind, asked, fallbacks, bad_node, probe, unused;
};

struct Found { double nonlinear; int32_t linearizations, unused; };  // newton.cu

struct Stamp { int64_t begin, end; };  // of a step, ns of the device's clock

struct Body {
    int64_t begin, bytes;          // of its blocks among the values of A
    int64_t place, size;           // bytes: of its nodes in x
    std::atomic<int32_t> wanted;   // 1: the blocks are asked for, 2: the positions
    int32_t coming;                // ... and under way
    std::atomic<int64_t> copied;   // step of the last copy made, -1: none
};

struct Batch {                     // steps that are looked at together
    char* upload;                  // pinned room for all that mailboxes may hold
    void* done;                    // event
    int64_t first, steps;          // steps completed before it; in it
    double late;
};

struct Picture { void *taken, *arrived; };  // events of a frame on its way

enum { DEPTH = 2, PICTURES = 4 };

struct Loop {
    const Cuda* cuda;
    void *context, *stream, *copies;   // copies: the stream that brings frames and matrices home
    void* graphs[2][2];                // [the device was idle: its clock is noted first][0: one step, 1: `many` steps or null]
    int64_t many;
    Mailbox* mailbox;
    Body* body;
    int32_t mailboxes, bodies;
    const Result* results;             // (capacity, bodies) pinned; the steps write there themselves
    const Stamp* stamps;               // (capacity,) likewise
    const Found* found;                // (capacity, bodies) likewise; null: one linearization a step
    const Energy* energies;            // (capacity, bodies) likewise
    void* account;                     // graph that has the energy of the last step told there, unless it has been
    void* elastic;                     // graph that adds its elastic energy
    int64_t capacity, batch;           // batch: most steps in one; divides the capacity
    Address values, staged;            // A of all bodies, and as much room beside
    char* matrices;                    // ... and on the host, pinned
    void *snapped, *home;              // events of matrices on their way
    Address x, v, pictures;            // pictures: room for PICTURES frames
    int64_t frame_bytes;               // of x
    double* clock;                     // (1,) s, for those who ask the host
    double span;                       // s that a batch lasts about, at most
    double poll;                       // s between looks at an event that is nearly due
    double step_seconds;               // of the last batch, 0: not known
    double idle;                       // when the device had nothing to do, or the last batch was seen done
    double cpu;                        // time of this thread when the last batch was finished
    int64_t begun, finished;           // batches
    std::atomic<int64_t> launched;     // steps
    int64_t drawn;                     // frames begun
    int64_t matrix_step;               // of the matrices on their way, -1: none are
    std::atomic<int32_t> asked;        // some body's matrix is wanted
    int32_t stalled;                   // the device has run dry meanwhile
    int32_t error;
    char where[28];                    // the call that failed
    Batch batches[DEPTH];
    Picture picture[PICTURES];
    Rings rings;
};

static bool failed(Loop& l, int32_t error, const char* where) {
    if (error && !l.error) {
        l.error = error;
        std::snprintf(l.where, sizeof l.where, "%s", where);
    }
    return l.error != 0;
}
#define CALL(function, ...) if (failed(l, l.cuda->function(__VA_ARGS__), #function)) return false

static bool done(Loop& l, void* event) {
    int32_t answer = l.cuda->event_query(event);
    if (answer == NOT_READY) return false;
    return !failed(l, answer, "event_query");
}

// Waits without burning the processor: sleeps until about when it is due, then looks again and again.
static bool await(Loop& l, void* event, double due = 0) {
    for (double begin = now(), t = begin; !done(l, event); t = now()) {
        if (l.error) return false;
        double over = t - (due > begin ? due : begin);
        if (over > 1) { CALL(event_wait, event); return true; }
        nap(over < 0 ? -over : l.poll + over / 8);
    }
    return !l.error;
}
