// SPDX-License-Identifier: MIT
// What a step leaves, one of each body but the timestamp. PcgResult stays on the device, which makes records of it (step_records.cu);
// the others are written into memory of the host and read by loop.cpp.
#pragma once

struct PcgResult {
    double residual;        // true, relative
    double seconds;
    long long factor_step;  // -1: no factor used
    int iterations, status, kind, asked, fallbacks, bad_node, probe;
    int at_rest;            // 1: the body rests, nothing was solved
    double solve_error;     // estimated, largest of a node [m]; 0: not known
};

struct NewtonResult {
    double nonlinear;       // |b| at the end of the step over the first |b|
    int linearizations;
    double step_error;      // estimated, largest of a node [m]; 0: not evaluated
};

struct StageResult {       // of a step by stages
    double estimate;       // of the error of the last attempt by stages, the largest of a node [m]
    double inconsistency;  // of the factor that stood alone (step_form.h)
    int form;              // StepForm
};

struct ContactResult {     // of a step with contact
    double residual;       // of the system with the law as it is at the end, relative; NaN: nothing was touched
    int contacts;          // rows that carry force
    int passes;            // solves
    int clipped;           // nodes held back at an obstacle beside the law
};

struct SubstepResult {    // of a step by explicit substeps
    double stable_step;   // of the body, as estimated last [s]
    int substeps;
};

struct RecordTarget {      // which steps the device is to write the records of, and where to; the host says it
    long long first, steps;  // steps completed before the first one; how many
    long long place;         // number of the first record in the ring
};

struct StepTimestamp { long long begin, end; };  // ns of the device's clock
