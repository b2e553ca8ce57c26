// SPDX-License-Identifier: MIT
// Marks functions that the native loop and GPU texts share and that need nothing of kernel.h.
#pragma once
#ifdef __CUDACC_RTC__
#define HOST_DEVICE __device__ __forceinline__
#define HOST_DEVICE_CALL __device__ __noinline__  // large
#else
#define HOST_DEVICE static inline
#define HOST_DEVICE_CALL static inline
#endif
