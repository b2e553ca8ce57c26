// SPDX-License-Identifier: MIT
// Epilogue of a step (step_epilogue.cuh), done by the thread block of its last kernel that finishes last. kernel_fusion.py appends it
// to that kernel.
#include "step_epilogue.cuh"

__device__ void finish_step(const StepEpilogue& t) {
    if (finishes_last(t)) end_step(t);
}
