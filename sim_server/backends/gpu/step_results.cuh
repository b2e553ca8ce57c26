// SPDX-License-Identifier: MIT
// What a step leaves for the host, one of each body but the timestamp. Written by the device into memory of the host, read by loop.cpp.
#pragma once

struct PcgResult {
    double residual;        // true, relative
    double seconds;
    long long factor_step;  // -1: no factor used
    int iterations, status, kind, asked, fallbacks, bad_node, probe;
};

struct NewtonResult {
    double nonlinear;       // |b| at the end of the step over the first |b|
    int linearizations;
};

struct StageResult {       // of a step by stages
    double estimate;       // of the error of the last attempt by stages, the largest of a node [m]
    double inconsistency;  // of the factor that stood alone (step_form.h)
    int form;              // StepForm
};

struct StepTimestamp { long long begin, end; };  // ns of the device's clock
