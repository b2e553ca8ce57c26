// SPDX-License-Identifier: MIT
#pragma once

// The clock of the device.
static __device__ __forceinline__ long long nanoseconds() {
    long long t;
    asm volatile("mov.u64 %0, %globaltimer;" : "=l"(t));
    return t;
}
