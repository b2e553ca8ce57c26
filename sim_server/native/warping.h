// SPDX-License-Identifier: MIT
// What becomes of the frames of a body's nodes in a step (kernels/nodes.cu); warping.py chooses.
#pragma once
#include "loop.h"

enum { HELD = 1, NOTED = 2, MOVED = 4, ADOPTED = 8 };  // kernels/nodes.cu
enum { NOTE_ALWAYS = 1, NOTE_COPIES = 2 };             // SolveSettings::note

static void take_factor(Body& body) {
    if (const Factor* next = body.mail.exchange(nullptr)) body.factor = next;
}

// Settings and factor of a step, in this order: who asks for a factor's use has posted it before. What is written to the settings
// later is for the next step, or a step would be recorded as asked for what it did not have.
static void take_orders(Body& body) {
    body.now = body.settings;
    take_factor(body);
}

// Before a step is assembled: also takes up the factor with which it will be solved, which frames are reckoned from.
static void begin_frames(Loop& loop, int index) {
    Body& body = loop.body[index];
    take_orders(body);
    loop.moving[index] = 0;
    const int note = body.now.note;
    int now = body.now.hold ? HELD | MOVED : body.warping & MOVED;
    if (body.factor && body.factor->step == body.noted && body.made != body.noted) {
        body.made = body.noted;
        now |= ADOPTED;
    }
    if (note == NOTE_ALWAYS || (note == NOTE_COPIES && body.snapshot.load(std::memory_order_relaxed))) {
        body.noted = loop.rings.step;
        now |= NOTED;
    }
    body.warping = loop.warping[index] = now;
}
