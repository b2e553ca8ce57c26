// SPDX-License-Identifier: MIT
// For functions that the native loop and GPU texts share, where kernel.h would be too much.
#pragma once
#ifdef __CUDACC_RTC__
#define ANYWHERE __device__ __forceinline__
#else
#define ANYWHERE static inline
#endif
