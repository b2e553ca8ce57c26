// SPDX-License-Identifier: MIT
// Programmatic dependent launch: a kernel is brought to the multiprocessors while the one before it still runs, and waits there.
//
// Every kernel that is launched so (overlap.py) calls these two first; what stands between them may only read what no kernel of the
// graph writes.
#pragma once

// Lets the next kernel come, once all thread blocks of this one are there.
__device__ __forceinline__ void let_next_come() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

// Waits until the kernel before this one is complete, and with it all those before.
__device__ __forceinline__ void wait_for_last() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}
