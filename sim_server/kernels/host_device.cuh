// SPDX-License-Identifier: MIT
// Marks functions that the native loop and GPU texts share and that need nothing of kernel.h.
#pragma once
#ifdef __CUDACC_RTC__
#define ANYWHERE __device__ __forceinline__
#else
#define ANYWHERE static inline
#endif
