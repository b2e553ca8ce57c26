// SPDX-License-Identifier: MIT
// What a step tells of a body. The loop of a CPU writes it whole; on a GPU the device writes all but the first seven members
// (backends/gpu/step_records.cu).
#pragma once
#include "energy_balance.cuh"
#include "kinds.h"

#ifdef __CUDACC_RTC__
#define UNKNOWN __longlong_as_double(0x7ff8000000000000ll)
#else
#define UNKNOWN __builtin_nan("")
#endif

// The step record: one body, one step. Python reads its columns from here; ObjectStep of protocol/messages.proto has those of the
// same name. On a GPU only the solve is timed apart: assemble and integrate are 0 there, whole is the step's time on the device.
struct Record {
    long long step = 0;         // steps completed
    double time = 0;            // of the simulation at the end of the step [s]
    double whole = 0;           // [s]
    double late = 0;            // start of the step after its deadline [s]
    double begin = 0;           // steady clock [s]
    double cpu = 0;             // processor time of the loop's thread in the whole step [s]
    int body = 0;
    int iterations = 0;
    long long factor_step = -1; // of the matrix that the factor was made from; -1: no factor used
    double residual = 0;        // true, |b - A y| / |b|; form FACTOR: |y.(b - A y)| / |y.b| of the first stage (step_form.h)
    double assemble = 0;        // [s], as the next two
    double solve = 0;
    double integrate = 0;
    double nonlinear = -1;      // |b| at the end of the step over the first |b|; -1: not evaluated
    double kinetic = UNKNOWN;   // energies (energy_balance.cuh) [J]; NaN: not evaluated
    double elastic = UNKNOWN;
    double gravity = UNKNOWN;
    double work = UNKNOWN;
    double budget = UNKNOWN;
    double stride = UNKNOWN;    // [m]
    int status = 0;             // Status
    int kind = 0;               // Kind used at the end of the solve
    int asked = 0;              // Kind that it began with
    int fallbacks = 0;          // solves that left their factor
    int bad_node = -1;          // first node of the body whose b is not finite
    int probe = 0;              // iterations after which the solve was to go over to the other Kind; 0: never
    int linearizations = 1;
    int form = 0;               // StepForm
    double estimate = UNKNOWN;  // of the error of the step, the largest of a node [m]; NaN: the scheme gives none
    double contact_residual = UNKNOWN;  // relative, with the law of contact at the end of the step; NaN: nothing was touched
    int contacts = 0;           // that carry force
    int passes = 0;             // solves for them
    int clipped = 0;            // nodes held back at an obstacle beside the law
    int halvings = 0;           // the step was made again by 2^halvings short ones; 0: it was not
    int at_rest = 0;            // 1: nothing was solved, since b of a body at rest is rounding, as the residual is; it says converged
    int substeps = 0;           // explicit ones of the step; 0: an implicit scheme
    double stable_step = UNKNOWN;  // largest stable substep as estimated last [s]; NaN: an implicit scheme
    double solve_error = UNKNOWN;  // estimated, of the positions, by the last linear solve, largest of a node [m]; NaN: not known
    double step_error = UNKNOWN;   // likewise of the step's equation, the former included; NaN: not evaluated
};

// solve: with the members of SolveResult (backends/cpu/native/pcg.h) or PcgResult (backends/gpu/step_results.cuh).
template <class Solve> HOST_DEVICE void note_solve(Record& record, const Solve& solve) {
    record.residual = solve.residual;
    record.solve = solve.seconds;
    record.iterations = solve.iterations;
    record.status = solve.status;
    record.kind = solve.kind;
    record.fallbacks = solve.fallbacks;
    record.at_rest = solve.at_rest;
}

// b: Balance or EnergyRecord of the body.
template <class B> HOST_DEVICE void note_energy(Record& record, const B& b) {
    record.kinetic = b.kinetic;
    record.elastic = b.elastic;
    record.gravity = b.gravity;
    record.work = b.work;
    record.budget = b.budget;
    record.stride = b.stride;
    const bool rests = b.phase == FROZEN && !b.found;
    if (b.phase != WELL && (rests || record.status != NOT_FINITE)) record.status = RUNAWAY;
    if (!rests) return;
    record.factor_step = -1;  // there was nothing to solve
    record.at_rest = 0;
    record.kind = record.asked;
}
