// SPDX-License-Identifier: MIT
// What becomes of the frames of a body's nodes in a step (kernels/nodes.cu); warping.py chooses.
#pragma once
#include "loop.h"

enum { HELD = 1, NOTED = 2, MOVED = 4, ADOPTED = 8 };  // kernels/nodes.cu
enum { NOTE_ALWAYS = 1, NOTE_COPIES = 2 };             // SolveSettings::note

static void take_factor(Body& body) {
    if (const Factor* next = body.mail.exchange(nullptr)) body.factor = next;
}

// Before a step is assembled: also takes up the factor with which it will be solved, which frames are reckoned from.
static void begin_frames(Loop& loop, int index) {
    Body& body = loop.body[index];
    take_factor(body);
    const int note = body.settings.note;
    int now = body.settings.hold ? HELD | MOVED : body.warping & MOVED;
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
