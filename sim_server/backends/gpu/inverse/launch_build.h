// SPDX-License-Identifier: MIT
// Launches a build of inverses (build_inverse.py) in one call, without Python's lock: who gets it back waits for other threads.
#pragma once
#include "../loop.h"

enum ValuesAre { PAGEABLE = 0, PAGE_LOCKED = 1, ON_DEVICE = 2 };

struct BuildLaunch {
    void* stream;
    void* copied;        // event, recorded once `staging` and the values may be written again; awaited first
    void* done;          // event, recorded after the build; null: the caller does that
    void* graph;
    const void* head;    // of what is copied to `incoming`, before the values
    int64_t head_bytes;
    char* staging;       // page-locked, of the size of what is copied
    Address incoming;
    const int64_t* runs; // (count, 3) of values: first byte behind the head, address, bytes
    int64_t count;
    int32_t values_are;  // ValuesAre
};

// Returns an error of the driver, or 0.
static int32_t launch_build(const CudaDriver& driver, const BuildLaunch& l) {
    if (int32_t error = driver.event_wait(l.copied)) return error;
    std::memcpy(l.staging, l.head, l.head_bytes);
    int64_t staged = l.head_bytes;
    for (int64_t k = 0; k < l.count && l.values_are == PAGEABLE; ++k) {
        std::memcpy(l.staging + l.head_bytes + l.runs[3 * k], (const void*)l.runs[3 * k + 1], l.runs[3 * k + 2]);
        staged += l.runs[3 * k + 2];
    }
    if (int32_t error = driver.to_device(l.incoming, l.staging, staged, l.stream)) return error;
    for (int64_t k = 0; k < l.count && l.values_are != PAGEABLE; ++k) {
        const int64_t* run = l.runs + 3 * k;
        const Address to = l.incoming + l.head_bytes + run[0];
        const int32_t error = l.values_are == ON_DEVICE ? driver.on_device(to, run[1], run[2], l.stream)
                                                        : driver.to_device(to, (const void*)run[1], run[2], l.stream);
        if (error) return error;
    }
    if (int32_t error = driver.event_record(l.copied, l.stream)) return error;
    if (int32_t error = driver.graph_launch(l.graph, l.stream)) return error;
    return l.done ? driver.event_record(l.done, l.stream) : 0;
}
