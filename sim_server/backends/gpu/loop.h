// SPDX-License-Identifier: MIT
// Memory of the GPU loop (loop.cpp), and its calls of the driver. structs.py holds the same layouts.
#pragma once
#include <algorithm>
#include <cstdio>
#include <cstring>
#include <vector>

#include "../cpu/native/ring_buffers.h"
#include "copy_list.cuh"
#include "step_results.cuh"

typedef uint64_t Address;       // of device memory

struct CudaDriver {             // functions of the CUDA driver API; each returns 0 or an error
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
    void* event;                 // null, or the event that must have completed before the bytes are used
    int64_t number;
    std::atomic<int64_t> taken;  // steps launched before it was copied to the device: it is valid for those after; -1: not copied yet
};

struct MailSlot {               // bytes on the device that are replaced between batches
    Address target;
    int64_t size;
    std::atomic<Mail*> posted;
    Mail* pending;               // taken out of `posted`; its event has not completed yet
    int64_t after;               // steps launched before the mail that was copied to the device last
    std::atomic<int64_t> taken;  // number of that mail
};

struct DeviceChanges {          // of parameters: copies that are made between the same two steps
    const DeviceCopy* copies;    // new contents of arrays on the device
    const int64_t* places;       // (bodies, 2) values_begin and values_bytes of each body from then on; null: as before
    void *before, *after;        // graphs that make work of the elastic energy that they add
    int64_t count;
    std::atomic<int64_t> taken;  // steps launched before them, -1: not yet
};

enum Request { REQUEST_VALUES = 1, REQUEST_POSITIONS = 2 };

struct BodyReadback {                    // copies of a body's matrix or positions to the host
    int64_t values_begin, values_bytes;  // its blocks among the values of A
    int64_t staged_begin;                // its place in the memory for copies, where bodies that are split have room for more
    int64_t x_begin, x_bytes;            // its nodes in x
    std::atomic<int32_t> requested;      // REQUEST_VALUES, REQUEST_POSITIONS or 0
    int32_t in_flight;                   // the same, of the copy under way
    std::atomic<int64_t> copied_step;    // step of the last copy that has arrived, -1: none
};

struct CopyLaunch {         // copies that the device makes in one launch
    char* list;             // page-locked: CopyList, contents of mail, copies (copy_list.cuh)
    Address target;         // memory of the device, of the same size, from which it reads them: over the bus each warp would wait
    void* graph;            // of copy_list.cu
};

struct StepBatch {                     // steps whose results are looked at together
    CopyLaunch mail;       // to the slots' targets; room for one mail of every slot
    void* done;            // event
    void* records;         // graph that settles the energy balance of the last step and writes the records that `target` says
    RecordTarget* target;  // pinned
    int64_t first, steps;  // steps completed before the batch; steps in it
    int64_t place;         // of its first record, which the device writes by itself; -1: the ring had no room for all of them
    double late;
    int32_t touched;       // 1: something is pushed or held in it
};

struct FrameCopy { void *taken, *arrived; };  // events: copied on the device, copied to the host

constexpr int STEP_BATCHES = 2, FRAME_COPIES = 4;  // under way at most
constexpr int GRAPH_SIZES = 3;  // numbers of steps of which there are graphs

struct GpuLoop {
    const CudaDriver* driver;
    void *context, *stream, *copy_stream;  // copy_stream: copies frames and matrices to the host
    void* graphs[2][GRAPH_SIZES];          // [1: begins by writing the time, for an idle device][of `sizes` steps; null: there is none]
    int64_t sizes[GRAPH_SIZES];            // 1, and then more and more
    MailSlot* mail_slots;
    BodyReadback* readbacks;               // (bodies,)
    int32_t mail_slot_count, bodies;
    std::atomic<int32_t> posted;           // 1: a slot may have mail
    const StepTimestamp* timestamps;       // (capacity,) pinned, written by the steps
    const NewtonResult* newton_results;    // (capacity, bodies) likewise; null: one linearization a step
    const StageResult* stage_results;      // (capacity, bodies) likewise; null: no scheme with stages
    const ContactResult* contact_results;  // (capacity, bodies) likewise; null: no contact
    const SubstepResult* substep_results;  // (capacity, bodies) likewise; null: an implicit scheme
    const double* contact_reactions;       // (capacity, bodies, obstacles, 6) likewise
    const double* held_reactions;          // (capacity, bodies, holders, 6) likewise
    const PairSum* pair_sums;              // (capacity, bodies, most_pairs) likewise; null: bodies do not touch each other
    const int32_t* pair_counts;            // (capacity, bodies) likewise, sums of each body; more than most_pairs have no place
    int64_t most_pairs;
    const double* measured;                // (capacity, measured_count) likewise; null: records come with no numbers of effects
    const int32_t* measured_first;         // (bodies + 1,) of those of each body
    int64_t measured_count;
    int64_t obstacles, holders;
    void* grabs;                           // graph that writes what bodies exert on grabs after a step; null: nothing can be touched
    const MailSlot* touch;                 // arguments of pushes and grabs
    const Reaction* grab_reactions;        // (capacity, most_grabs) pinned, written by `grabs`; number -1: no grab
    const int64_t* grab_counts;            // (capacity,) likewise
    int64_t most_grabs;
    int32_t touched;                       // 1: the arguments delivered last push or hold something
    void* energy_balance;                  // graph that settles the energy balance of the last step, unless that has been done
    void* elastic_energy;                  // graph that adds the elastic energy to it
    void* matrix;                          // graph that makes A of the next step, for a copy; null: each step makes its own
    int64_t capacity, batch;               // batch: most steps in one; divides the capacity
    Address values, staged;                // A of all bodies; memory of the same size for copies of it
    char* host_matrices;                   // pinned, of the same size
    CopyLaunch matrices;                   // of matrices and positions from where steps have them to `staged`; room for one of each body
    void *staged_event, *copied_event;     // of the matrices under way: copied on the device, copied to the host
    Address x, v, frame_staging;           // frame_staging: memory for FRAME_COPIES frames
    int64_t frame_bytes;                   // of x
    Address poses, pose_staging;           // of obstacles, likewise; nothing without contact
    int64_t pose_bytes;                    // of all obstacles; 0 without contact
    double* clock;                         // (1,) time of the simulation [s], for readers on the host
    double batch_seconds;                  // largest aim for the duration of a batch [s]
    double exchange_seconds;               // likewise while matrices are asked for and mail comes
    double lead;                           // [s] before the end of a batch the next one is launched then
    double copy_poll;                      // [s] between queries of copies that are nearly there
    double poll;                           // [s] between queries of an event that is nearly due
    double step_seconds;                   // of the last batch, 0: not known
    double idle_since;                     // time at which the device ran dry, or the end of the last batch was seen
    double cpu;                            // processor time of this thread when the last batch was finished
    int64_t begun, finished;               // batches
    std::atomic<int64_t> launched;         // steps
    int64_t frames_begun;
    int64_t matrix_step;                   // of the matrices or positions under way, -1: none
    std::atomic<int32_t> requested;        // 1: a readback has a request
    int32_t ran_dry;                       // 1: the device had nothing to do since the last launch
    int32_t error;
    char failed_call[28];
    StepBatch batches[STEP_BATCHES];
    FrameCopy frame_copies[FRAME_COPIES];
    std::atomic<DeviceChanges*> changes;   // of parameters, or null
    Rings rings;
};

static bool failed(GpuLoop& l, int32_t error, const char* where) {
    if (error && !l.error) {
        l.error = error;
        std::snprintf(l.failed_call, sizeof l.failed_call, "%s", where);
    }
    return l.error != 0;
}
#define CALL(function, ...) if (failed(l, l.driver->function(__VA_ARGS__), #function)) return false

static bool done(GpuLoop& l, void* event) {
    int32_t answer = l.driver->event_query(event);
    if (answer == NOT_READY) return false;
    return !failed(l, answer, "event_query");
}

// Has the device make copies, in the order of the steps. used: bytes of the list before them.
static bool make_copies(GpuLoop& l, const CopyLaunch& launch, const std::vector<DeviceCopy>& copies, int64_t used = sizeof(CopyList)) {
    if (copies.empty()) return true;
    const CopyList begin = {(long long)copies.size(), used};
    const size_t bytes = copies.size() * sizeof(DeviceCopy);
    std::memcpy(launch.list, &begin, sizeof begin);
    std::memcpy(launch.list + used, copies.data(), bytes);
    CALL(to_device, launch.target, launch.list, (size_t)used + bytes, l.stream);
    CALL(graph_launch, launch.graph, l.stream);
    return true;
}

// Waits for an event without a busy loop: sleeps until about when it is due, then queries it at intervals, which are longer where the
// work before it lasts longer. due: steady clock [s]. lasts [s]. meanwhile: is called before each nap, and returns the longest one [s].
template <class Meanwhile>
static bool await(GpuLoop& l, void* event, double due, double lasts, Meanwhile meanwhile) {
    for (double begin = now(), t = begin; !done(l, event); t = now()) {
        if (l.error) return false;
        double over = t - (due > begin ? due : begin);
        if (over > 1) { CALL(event_wait, event); return true; }
        const double pause = over < 0 ? -over : l.poll + lasts / 64 + over / 8;
        nap(std::min(pause, meanwhile()));
    }
    return !l.error;
}
static bool await(GpuLoop& l, void* event) { return await(l, event, 0, 0, [] { return 1.0; }); }
