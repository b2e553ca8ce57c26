// SPDX-License-Identifier: MIT
// Frames and matrices on their way home, beside the steps: copied aside on the device in the order of the steps, then to the
// host on a stream of their own, and told of when they are there.
#pragma once
#include "loop.h"

// Positions go through the room of the blocks: each node has at least its own.
static int64_t coming_bytes(const Body& body) { return body.coming == 1 ? body.bytes : body.size; }

static bool begin_matrices(Loop& l) {
    if (l.matrix_step >= 0 || !l.asked.exchange(0, std::memory_order_acquire)) return true;
    for (int i = 0; i < l.bodies; ++i) {
        Body& body = l.body[i];
        body.coming = body.wanted.exchange(0, std::memory_order_acquire);
        if (!body.coming) continue;
        Address from = body.coming == 1 ? l.values + body.begin : l.x + body.place;
        CALL(on_device, l.staged + body.begin, from, (size_t)coming_bytes(body), l.stream);
    }
    CALL(event_record, l.snapped, l.stream);
    CALL(stream_wait, l.copies, l.snapped, 0);
    for (int i = 0; i < l.bodies; ++i) {
        Body& body = l.body[i];
        if (body.coming)
            CALL(to_host, l.matrices + body.begin, l.staged + body.begin, (size_t)coming_bytes(body), l.copies);
    }
    CALL(event_record, l.home, l.copies);
    l.matrix_step = l.launched - 1;  // steps completed when they were assembled; positions are those after it
    return true;
}

static void publish_matrices(Loop& l) {
    for (int i = 0; i < l.bodies; ++i)
        if (l.body[i].coming) {
            l.body[i].coming = 0;
            l.body[i].copied.store(l.matrix_step, std::memory_order_release);
        }
    l.matrix_step = -1;
}

// Tells of what has come home; never waits.
static void publish(Loop& l) {
    if (l.matrix_step >= 0 && done(l, l.home)) publish_matrices(l);
    while (l.rings.frame_head.load() < l.drawn && done(l, l.picture[l.rings.frame_head.load() % PICTURES].arrived))
        l.rings.frame_head.fetch_add(1, std::memory_order_release);
}

static bool oldest_frame_home(Loop& l) {
    if (!await(l, l.picture[l.rings.frame_head.load() % PICTURES].arrived)) return false;
    l.rings.frame_head.fetch_add(1, std::memory_order_release);
    return true;
}

// A full ring: wait if nobody minds, else say no.
static bool room_for_frame(Loop& l) {
    Rings& rings = l.rings;
    while (l.drawn - rings.frame_head.load() >= PICTURES)  // as fast as the device gets there
        if (!oldest_frame_home(l)) return false;
    while (l.drawn - rings.frame_tail.load(std::memory_order_acquire) >= rings.frame_capacity) {
        if (!rings.patient || rings.stop.load() || l.error) return false;
        l.stalled = 1;
        publish(l);
        nap(1e-4);
    }
    return true;
}

static bool begin_frame(Loop& l) {
    const int64_t every = l.rings.frame_every.load(), bytes = l.frame_bytes;  // once: it may become 0 meanwhile
    if (every <= 0 || l.launched % every) return true;
    if (!room_for_frame(l)) { ++l.rings.frames_dropped; return !l.error; }
    int64_t slot = l.drawn % l.rings.frame_capacity;
    Picture& picture = l.picture[l.drawn % PICTURES];
    Address aside = l.pictures + 2 * bytes * (l.drawn % PICTURES);
    CALL(on_device, aside, l.x, (size_t)bytes, l.stream);
    CALL(on_device, aside + bytes, l.v, (size_t)bytes, l.stream);
    CALL(event_record, picture.taken, l.stream);
    CALL(stream_wait, l.copies, picture.taken, 0);
    CALL(to_host, (char*)l.rings.frames + 2 * bytes * slot, aside, (size_t)(2 * bytes), l.copies);
    CALL(event_record, picture.arrived, l.copies);
    l.rings.frame_steps[slot] = l.launched;
    ++l.drawn;
    return true;
}

// Waits for all that is on its way.
static bool all_home(Loop& l) {
    while (l.rings.frame_head.load() < l.drawn)
        if (!oldest_frame_home(l)) return false;
    if (l.matrix_step >= 0) {
        if (!await(l, l.home)) return false;
        publish_matrices(l);
    }
    return true;
}
