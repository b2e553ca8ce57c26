// SPDX-License-Identifier: MIT
// How a step was made; the numbers stand in records and logs (StepForm in protocol/messages.proto).
#pragma once

// ONE_SOLVE: by a scheme without stages. ITERATE, FACTOR: by the stages of a Rosenbrock-W method, whose matrix is that of the step,
// solved by iterations, or an older one, whose factor is applied once. EULER: by backward Euler, since the estimate was too large.
enum StepForm { ONE_SOLVE = 0, ITERATE = 1, FACTOR = 2, EULER = 3 };

constexpr double POOR = 0.5;          // a factor leaves this share of a residual or more: it is not used alone
constexpr int CHECK_EVERY = 200;      // steps after which the residual of a factor used alone is evaluated again
constexpr int PATIENCE = 8;           // steps that iterate after one whose factor alone did not do
