// SPDX-License-Identifier: MIT
// Copies of frames and matrices from the device to the host, beside the steps: first copies within the device in the order of
// the steps, those of matrices in one launch, then copies to the host on another stream. They are published once they have arrived.
#pragma once
#include "loop.h"

// Bytes of the copy under way. Positions use the staging memory of the blocks, of which each node has at least one.
static int64_t readback_bytes(const BodyReadback& body) { return body.in_flight == REQUEST_VALUES ? body.values_bytes : body.x_bytes; }

// Whether a request is met before a step: a matrix that no step makes by itself is made then. All others are met after a step.
static bool met_before(const GpuLoop& l, int32_t request) { return l.matrix && request == REQUEST_VALUES; }

// Lists the requests that are met before, or after, a step as copies within the device, in the order of their targets.
static void list_copies(GpuLoop& l, bool before, std::vector<DeviceCopy>& copies) {
    bool others = false;
    for (int i = 0; i < l.bodies; ++i) {
        BodyReadback& body = l.readbacks[i];
        int32_t request = body.requested.load(std::memory_order_acquire);
        if (!request) continue;
        if (met_before(l, request) != before || !body.requested.compare_exchange_strong(request, 0)) {
            others = true;
            continue;
        }
        body.in_flight = request;
        const Address from = request == REQUEST_VALUES ? l.values + body.values_begin : l.x + body.x_begin;
        copies.push_back({(char*)(l.staged + body.staged_begin), (const char*)from, readback_bytes(body)});
    }
    if (others) l.requested.store(1, std::memory_order_release);
    std::sort(copies.begin(), copies.end(), [](const DeviceCopy& a, const DeviceCopy& b) { return a.target < b.target; });
}

// Begins to bring to the host what copies have made, those whose places adjoin in one transfer. copies: in the order of their targets
static bool begin_transfers(GpuLoop& l, const std::vector<DeviceCopy>& copies) {
    CALL(event_record, l.staged_event, l.stream);
    CALL(stream_wait, l.copy_stream, l.staged_event, 0);
    for (size_t k = 0; k < copies.size();) {
        const Address place = (Address)copies[k].target;
        int64_t bytes = copies[k].bytes;
        while (++k < copies.size() && (Address)copies[k].target == place + bytes) bytes += copies[k].bytes;
        CALL(to_host, l.host_matrices + (place - l.staged), place, (size_t)bytes, l.copy_stream);
    }
    CALL(event_record, l.copied_event, l.copy_stream);
    return true;
}

// Begins the copies that are met before, or after, the step launched next, or last.
static bool begin_matrices(GpuLoop& l, bool before) {
    if (l.matrix_step >= 0 || (before && !l.matrix) || !l.requested.exchange(0, std::memory_order_acquire)) return true;
    static thread_local std::vector<DeviceCopy> copies;
    copies.clear();
    list_copies(l, before, copies);
    if (copies.empty()) return true;
    if (before) CALL(graph_launch, l.matrix, l.stream);
    if (!make_copies(l, l.matrices, copies) || !begin_transfers(l, copies)) return false;
    l.matrix_step = before ? l.launched.load() : l.launched - 1;  // steps completed before the matrix was assembled; positions are those after that step
    return true;
}

static void publish_matrices(GpuLoop& l) {
    for (int i = 0; i < l.bodies; ++i)
        if (l.readbacks[i].in_flight) {
            l.readbacks[i].in_flight = 0;
            l.readbacks[i].copied_step.store(l.matrix_step, std::memory_order_release);
        }
    l.matrix_step = -1;
    wake(l.rings);
}

// Publishes the copies that have arrived, without waiting.
static void publish(GpuLoop& l) {
    if (l.matrix_step >= 0 && done(l, l.copied_event)) publish_matrices(l);
    while (l.rings.frame_head.load() < l.frames_begun && done(l, l.frame_copies[l.rings.frame_head.load() % FRAME_COPIES].arrived))
        l.rings.frame_head.fetch_add(1, std::memory_order_release);
}

// Publishes copies that arrive while something else is awaited; returns how soon to look again [s].
static double publish_meanwhile(GpuLoop& l) {
    const auto under_way = [&l] { return l.matrix_step >= 0 && l.rings.step > l.matrix_step; };  // and their step is over
    if (under_way()) publish(l);
    return under_way() ? l.copy_poll : 1;
}

static bool finish_oldest_frame(GpuLoop& l) {
    if (!await(l, l.frame_copies[l.rings.frame_head.load() % FRAME_COPIES].arrived)) return false;
    l.rings.frame_head.fetch_add(1, std::memory_order_release);
    return true;
}

// Begins to copy x, v and poses of obstacles of the last step launched to the ring of frames, if they are wanted.
static bool copy_frame(GpuLoop& l) {
    const int64_t bytes = l.frame_bytes;
    const int64_t slot = begin_frame(l.rings, l.frames_begun, l.launched, [&] {
        l.ran_dry = 1;
        publish(l);
        return !l.error;
    });
    if (slot < 0) return !l.error;
    while (l.frames_begun - l.rings.frame_head.load() >= FRAME_COPIES)  // as fast as the device gets there
        if (!finish_oldest_frame(l)) return false;
    FrameCopy& copy = l.frame_copies[l.frames_begun % FRAME_COPIES];
    Address staging = l.frame_staging + 2 * bytes * (l.frames_begun % FRAME_COPIES);
    CALL(on_device, staging, l.x, (size_t)bytes, l.stream);
    CALL(on_device, staging + bytes, l.v, (size_t)bytes, l.stream);
    const Address poses = l.pose_staging + l.pose_bytes * (l.frames_begun % FRAME_COPIES);
    if (l.pose_bytes) CALL(on_device, poses, l.poses, (size_t)l.pose_bytes, l.stream);
    CALL(event_record, copy.taken, l.stream);
    CALL(stream_wait, l.copy_stream, copy.taken, 0);
    CALL(to_host, (char*)l.rings.frames + 2 * bytes * slot, staging, (size_t)(2 * bytes), l.copy_stream);
    if (l.pose_bytes) CALL(to_host, (char*)l.rings.frame_poses + l.pose_bytes * slot, poses, (size_t)l.pose_bytes, l.copy_stream);
    CALL(event_record, copy.arrived, l.copy_stream);
    ++l.frames_begun;
    return true;
}

// Waits for all copies under way.
static bool finish_readbacks(GpuLoop& l) {
    while (l.rings.frame_head.load() < l.frames_begun)
        if (!finish_oldest_frame(l)) return false;
    if (l.matrix_step >= 0) {
        if (!await(l, l.copied_event)) return false;
        publish_matrices(l);
    }
    return true;
}
