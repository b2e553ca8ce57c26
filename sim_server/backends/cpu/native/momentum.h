// SPDX-License-Identifier: MIT
// Momenta of bodies that nothing holds, in a Rosenbrock-W step (method: kernels/rigid_motion.h).
#pragma once
#include "loop.h"

// Adds what the forces of a stage do, from b before it is solved. start: x at the start of the step. False if a spring holds the body:
// then it is not free.
static bool add_impulses(const Loop& loop, const Body& body, const double* start, MomentumSums& sums) {
    const Stages& stages = *loop.stages;
    const Vector3 origin = at3(start, body.first);
    for (int i = body.first; i < body.last; ++i) {
        const double mass = stages.mass[i], inert = mass * stages.weight[i] / stages.share[i];  // without springs
        if (stages.diagonal[i] > inert * (1 + 1e-9)) return false;
        add_impulse(sums, at3(loop.x, i) - origin, at3(stages.b, i) - mass * at3(stages.inertial_increment, i));
    }
    return true;
}

// Gives the velocities of the step the momenta that its forces make. sums: the impulses of both stages.
static void set_momenta(Loop& loop, const Body& body, MomentumSums sums) {
    const Stages& stages = *loop.stages;
    const Vector3 origin = at3(stages.start_x, body.first);
    for (int i = body.first; i < body.last; ++i)
        add_motion(sums, stages.mass[i], at3(stages.start_x, i) - origin, at3(stages.start_v, i), at3(loop.x, i) - origin, at3(loop.v, i));
    const RigidMotion motion = rigid_motion(sums);
    for (int i = body.first; i < body.last; ++i) put3(loop.v, i, moved(motion, at3(loop.x, i) - origin, at3(loop.v, i)));
}
