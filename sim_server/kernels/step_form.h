// SPDX-License-Identifier: MIT
// How a step was made; the numbers stand in records and logs (StepForm in protocol/messages.proto).
#pragma once
#include "host_device.cuh"

// ONE_SOLVE: by a scheme without stages. ITERATE, FACTOR: by the stages of a Rosenbrock-W method, whose matrix is that of the step,
// solved by iterations, or an older one, whose factor is applied once. EULER: by backward Euler, since the
// estimate was too large, or the body touches something.
enum StepForm { ONE_SOLVE = 0, ITERATE = 1, FACTOR = 2, EULER = 3 };

constexpr int PATIENCE = 8;  // steps that iterate after one whose factor alone did not do

// A factor used alone is checked in every step, at no cost: the forces of both stages tell A y_1, as far as they are linear,
//     b_1 - A y_1 = (1 - g) b_1 + g b_2 - M ((1 - g) w s_1 + g (r_2 + w s_2) + u_1) + (1 - theta) D ((1 - g) s_1 + g s_2)
// with D the springs on the diagonal of A, which have no damping.
// y_1 . (b_1 - A y_1) is up to 2e-3 of y_1 . b_1 with factors that are 32 steps old (beams of 540 and 3000 tets, time steps of 10 to
// 30 ms), and 1 - 1 / c of it where the factor is that of c A, which no estimate shows: then nothing moves, as exactly as one likes.
constexpr double INCONSISTENT = 0.1;
constexpr double ROS2_GAMMA = 0.29289321881345247559915563789515;  // g = 1 - 1 / sqrt 2

// Entry of b_1 - A y_1. start: theta s_1; first, second: b_1, b_2; diagonal: of A [kg]; the others at its node.
HOST_DEVICE double first_residual(double start, double first, double second, double y, double theta, double w, double mass,
                                  double diagonal) {
    constexpr double g = ROS2_GAMMA;
    const double v = start / theta, u = y - start, s = (1 / g - 2) * u - v, springs = diagonal - mass * w / theta;
    return (1 - g) * first + g * second - mass * ((1 - g) * w * v + g * (w * s - 2 * u) + u) +
           (1 - theta) * springs * ((1 - g) * v + g * s);
}
