// SPDX-License-Identifier: MIT
// What a body exerts in a step on something that is no obstacle (those have an array of their own, ring_buffers.h).
#pragma once

enum ReactionKind {
    ON_GRAB = 0,    // number: id of the interaction; point: where it holds
    ON_OBJECT = 1,  // number: the other body; point: mean of the contacts, weighted by normal force
};

struct Reaction {
    long long step;    // steps completed
    long long number;  // by kind
    int body;          // that exerts it
    int kind;          // ReactionKind
    double force[3];   // N
    double torque[3];  // N m, about `point`
    double point[3];   // m, at the end of the step
};

struct PairSum {       // of the rows of a body against another one
    int other;
    double normal;     // sum of the normal forces [N]
    double force[3];   // on the body [N]
    double torque[3];  // about the origin [N m]
    double point[3];   // sum of the points, times normal force [N m]
};
