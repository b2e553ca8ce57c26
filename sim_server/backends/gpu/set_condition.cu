// SPDX-License-Identifier: MIT
// Sets the condition of a conditional node of a graph from device memory (conditions.py).

// Of the driver, which links it when it loads the module.
extern "C" __device__ void cudaGraphSetConditional(unsigned long long handle, unsigned value);

extern "C" __global__ void set_condition(unsigned long long handle, const int* flag) { cudaGraphSetConditional(handle, *flag != 0); }
