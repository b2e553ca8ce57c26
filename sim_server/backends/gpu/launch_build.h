// SPDX-License-Identifier: MIT
// Launches a build of inverses (build_inverse.py) in one call, without Python's lock: who gets it back waits for other threads.
#pragma once
#include "loop.h"

enum ValuesAre { PAGEABLE = 0, PAGE_LOCKED = 1, ON_DEVICE = 2 };

struct BuildLaunch {
    void* stream;
    void* copied;             // event, recorded once `staging` and the values may be written again; awaited first
    void* done;               // event, recorded after the build; null: the caller does that
    void* graph;
    const void* head;         // of what is copied to `incoming`, before the values
    int64_t head_bytes;
    char* staging;            // page-locked, of the size of what is copied
    Address incoming;
    const uint64_t* sources;  // (count,) addresses of the values of each factor
    int64_t count, bytes;     // bytes: of the values of each
    int32_t values_are;       // ValuesAre
};

// Copies the values of factors behind the head, those that lie one behind the other together. Returns an error of the driver, or 0.
static int32_t copy_values(const CudaDriver& driver, const BuildLaunch& l) {
    Address to = l.incoming + l.head_bytes;
    for (int64_t k = 0, end; k < l.count; k = end) {
        for (end = k + 1; end < l.count && l.sources[end] == l.sources[end - 1] + l.bytes;) ++end;
        const size_t size = (end - k) * l.bytes;
        const int32_t error = l.values_are == ON_DEVICE ? driver.on_device(to, l.sources[k], size, l.stream)
                                                        : driver.to_device(to, (const void*)l.sources[k], size, l.stream);
        if (error) return error;
        to += size;
    }
    return 0;
}

// Returns an error of the driver, or 0.
static int32_t launch_build(const CudaDriver& driver, const BuildLaunch& l) {
    if (int32_t error = driver.event_wait(l.copied)) return error;
    char* next = l.staging;
    std::memcpy(next, l.head, l.head_bytes);
    next += l.head_bytes;
    for (int64_t k = 0; k < l.count && l.values_are == PAGEABLE; ++k, next += l.bytes) std::memcpy(next, (const void*)l.sources[k], l.bytes);
    if (int32_t error = driver.to_device(l.incoming, l.staging, next - l.staging, l.stream)) return error;
    if (l.values_are != PAGEABLE)
        if (int32_t error = copy_values(driver, l)) return error;
    if (int32_t error = driver.event_record(l.copied, l.stream)) return error;
    if (int32_t error = driver.graph_launch(l.graph, l.stream)) return error;
    return l.done ? driver.event_record(l.done, l.stream) : 0;
}
