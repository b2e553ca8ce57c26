// SPDX-License-Identifier: MIT
// Marks functions that the native loop and GPU texts share and that need nothing of kernel.h.
#pragma once
#ifdef __CUDACC_RTC__
#define HOST_DEVICE __device__ __forceinline__
#else
#define HOST_DEVICE static inline
#endif
