// SPDX-License-Identifier: MIT
// One text, two compilers. A kernel is a function of independent items:
//
//     struct Move { int n; const real* v; real* x; real h; };                      // n = items, always first
//     KERNEL(move, Move) { put(p.x, i, at(p.x, i) + p.h * at(p.v, i)); }           // `p` parameters, `i` item
//
// NVRTC turns it into a __global__ function, one thread per item; a C++ compiler into a loop over a range of items.
// A text that defines WIDE first is written on `number` and `index`: scalars on a GPU, as many items at once as a vector
// register holds on a CPU (past the end the last item is repeated; an item loads before it stores, so that does no harm).
// `real` is the type of the state and of the system, `local` that of an element's own arithmetic and of what it hands on; a
// GPU may have float there beside double (`local_number` beside `number`).
// `own<T>` is an array (n, k) whose rows only their items touch, from launch to launch of a domain: where launches are put
// together (backends/gpu/kernel_fusion.py) such a row stays in registers.
// SUM_KERNEL(name, Params, N) is for items that sum N locals over a list of entries p.start[i] .. p.start[i + 1]: the text has
// name_add(p, i, k, sum) for entry k and name_put(p, i, sum) for what becomes of the sum; a GPU may share the entries of an
// item between threads (backends/gpu/kernel_fusion.py), so name_add reads nothing that items of its own domain write.
// MAILED_KERNEL is the same for a launch whose arguments are replaced while the simulation runs: on a GPU it reads them from
// device memory and takes any number of items.
// at(a, i) reads any items, at_items(a, i) those of the kernel itself: neighbours in memory.
// Structs hold 4-byte ints, reals and pointers; the Python side reads their layout from this very text
// (backends/kernel_binding.py), so that names and order stand nowhere else.
#pragma once

#ifndef real
#define real double
#endif
#ifndef local
#define local real
#endif

#ifdef __CUDACC_RTC__

#define INLINE __device__ __forceinline__
#define INLINE_MEMBER __device__ __forceinline__
#define OUT_OF_LINE __device__ __noinline__  // rare and large: its registers would be everybody's
#define UNROLL _Pragma("unroll")
typedef real number;
typedef local local_number;
typedef double exact_number;  // of small differences of large terms, whatever the precision
typedef int index;
constexpr int LANES = 1;
template <class T> using entry = T;  // one of the scalars in a number
INLINE bool any(bool mask) { return mask; }  // is it so for one of the items at hand?
INLINE void mark(int* a, index i, bool mask) { if (mask) a[i] = 1; }

#ifndef BLOCK_ITEMS  // of a thread block; neighbouring threads have neighbouring items
#define BLOCK_ITEMS 128
#endif

#ifdef ITEMS_ONLY  // the texts of several kernels are put together into one
template <class T> struct own { T* item; };
#define KERNEL(name, Params) INLINE void name##_item(const Params& p, index i)
#define MAILED_KERNEL(name, Params) KERNEL(name, Params)
#define SUM_KERNEL(name, Params, N) [[maybe_unused]] static constexpr int name##_sums = N;
#else
template <class T> using own = T*;
#define KERNEL(name, Params)                                                \
    __device__ __forceinline__ void name##_item(const Params& p, index i);  \
    extern "C" __global__ void name(const Params p) {                       \
        int i = blockIdx.x * blockDim.x + threadIdx.x;                      \
        if (i < p.n) name##_item(p, i);                                     \
    }                                                                       \
    __device__ __forceinline__ void name##_item(const Params& p, index i)
#define MAILED_KERNEL(name, Params)                                         \
    __device__ __forceinline__ void name##_item(const Params& p, index i);  \
    extern "C" __global__ void name(const Params* mail) {                   \
        const Params p = *mail;                                             \
        for (int i = blockIdx.x * blockDim.x + threadIdx.x; i < p.n; i += gridDim.x * blockDim.x) name##_item(p, i); \
    }                                                                       \
    __device__ __forceinline__ void name##_item(const Params& p, index i)
#define SUM_KERNEL(name, Params, N) KERNEL(name, Params) { SUM_OF_ENTRIES(name, N) }
#endif

#else

#include <cmath>
#define INLINE static inline __attribute__((always_inline))
#define INLINE_MEMBER inline __attribute__((always_inline))
#define OUT_OF_LINE static __attribute__((noinline, unused))
#define UNROLL _Pragma("GCC unroll 16")
template <class T> using own = T*;
// `begin`..`end` lets the caller share a launch between threads.
#define KERNEL(name, Params)                                                          \
    INLINE void name##_item(const Params& p, index i);                                \
    extern "C" void name(const void* params, int begin, int end) {                    \
        const Params p = *static_cast<const Params*>(params);                         \
        for (int i = begin; i < end; i += LANES) name##_item(p, items(i, end - 1));   \
    }                                                                                 \
    INLINE void name##_item(const Params& p, index i)
#define MAILED_KERNEL(name, Params) KERNEL(name, Params)
#define SUM_KERNEL(name, Params, N) KERNEL(name, Params) { SUM_OF_ENTRIES(name, N) }

#ifdef WIDE

#if defined(__AVX512F__)
#define REGISTER 64
#elif defined(__AVX__)
#define REGISTER 32
#else
#define REGISTER 16
#endif
constexpr int LANES = REGISTER / sizeof(real);
typedef real number __attribute__((vector_size(REGISTER)));
typedef number local_number;
typedef number exact_number;
template <class T> using entry = real;
typedef int index __attribute__((vector_size(LANES * sizeof(int))));

INLINE index items(int first, int last) {
    index i;
    for (int k = 0; k < LANES; ++k) i[k] = first + k < last ? first + k : last;
    return i;
}
INLINE number at(const real* a, index i) {
    number r;
    for (int k = 0; k < LANES; ++k) r[k] = a[i[k]];
    return r;
}
INLINE index at(const int* a, index i) {
    index r;
    for (int k = 0; k < LANES; ++k) r[k] = a[i[k]];
    return r;
}
INLINE void put(real* a, index i, number v) {
    for (int k = 0; k < LANES; ++k) a[i[k]] = v[k];
}
INLINE number at_items(const real* a, index i) {
    if (i[LANES - 1] - i[0] != LANES - 1) return at(a, i);
    number r;
    __builtin_memcpy(&r, a + i[0], sizeof r);
    return r;
}
#define BY_LANES(name)                                        \
    INLINE number name(number a) {                            \
        for (int k = 0; k < LANES; ++k) a[k] = std::name(a[k]); \
        return a;                                             \
    }
BY_LANES(sqrt)
#define IS_double 1
#define PASTED(a, b) a##b
#define IS(type) PASTED(IS_, type)
#if IS(real)
#include "vector_math.h"
#else
BY_LANES(log)
BY_LANES(exp)
BY_LANES(cbrt)
#endif
template <class V> INLINE auto lane(V a, int k) { return a[k]; }
template <class M> INLINE bool any(M mask) {
    bool found = false;
    for (int k = 0; k < LANES; ++k) found |= mask[k] != 0;
    return found;
}
template <class M> INLINE void mark(int* a, index i, M mask) {
    for (int k = 0; k < LANES; ++k)
        if (mask[k]) a[i[k]] = 1;
}
INLINE number as_number(index a) {
    number r;
    for (int k = 0; k < LANES; ++k) r[k] = a[k];
    return r;
}
INLINE bool any(index a) {
    for (int k = 0; k < LANES; ++k)
        if (a[k]) return true;
    return false;
}

#else

constexpr int LANES = 1;
typedef real number;
typedef local local_number;
typedef double exact_number;
template <class T> using entry = T;
typedef int index;
INLINE index items(int first, int) { return first; }
using std::sqrt;
using std::log;
using std::exp;
using std::cbrt;
template <class V> INLINE V lane(V a, int) { return a; }
INLINE bool any(bool mask) { return mask; }
INLINE void mark(int* a, index i, bool mask) { if (mask) a[i] = 1; }

#endif
#endif

#if !defined(WIDE) || defined(__CUDACC_RTC__)
template <class T> INLINE T at(const T* a, index i) { return a[i]; }
template <class T> INLINE void put(T* a, index i, T v) { a[i] = v; }
INLINE number as_number(index a) { return a; }
INLINE bool any(index a) { return a; }
template <class T> INLINE T at_items(const T* a, index i) { return a[i]; }
#endif

// Entry k of row i of an array (n, K).
template <int K, class T> INLINE auto row_at(const T* a, index i, int k) { return at(a, K * i + k); }
template <int K, class T, class N> INLINE void row_put(T* a, index i, int k, N v) { put(a, K * i + k, v); }
#if defined(__CUDACC_RTC__) && defined(ITEMS_ONLY)
template <int K, class T> INLINE T row_at(own<T> a, index, int k) { return a.item[k]; }
template <int K, class T, class N> INLINE void row_put(own<T> a, index, int k, N v) { a.item[k] = v; }
#endif

#define SUM_OF_ENTRIES(name, N)                                                   \
    local sum[N];                                                                 \
    for (int m = 0; m < N; ++m) sum[m] = 0;                                       \
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) name##_add(p, i, k, sum);   \
    name##_put(p, i, sum);

#ifdef __CUDACC_RTC__
template <class T> INLINE T inverse_root(T a) { return rsqrt(a); }
#else
template <class T> INLINE T inverse_root(T a) { return 1 / sqrt(a); }
#endif
template <class T> INLINE T larger(T a, T b) { return a > b ? a : b; }
template <class T> INLINE T smaller(T a, T b) { return a < b ? a : b; }
template <class T> INLINE T magnitude(T a) { return a < 0 ? -a : a; }
