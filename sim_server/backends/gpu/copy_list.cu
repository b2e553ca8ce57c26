// SPDX-License-Identifier: MIT
// Makes the copies of a list (copy_list.cuh), in words of eight bytes where addresses and sizes allow it, else of four.
#include "copy_list.cuh"

constexpr int THREADS = 256;

// Copies a part of the words from thread block `part` of `parts` on.
template <class Word> __device__ __forceinline__ void copy_words(const DeviceCopy& copy, int part, int parts) {
    const Word* __restrict__ from = (const Word*)copy.source;
    Word* __restrict__ to = (Word*)copy.target;
    const long long words = copy.bytes / (long long)sizeof(Word), step = (long long)parts * THREADS;
#pragma unroll 4
    for (long long k = (long long)part * THREADS + threadIdx.x; k < words; k += step) to[k] = from[k];
}

// The thread blocks share the copies: each makes one or more of them, or a part of one.
extern "C" __global__ void __launch_bounds__(THREADS) make_copies(const CopyList* list) {
    const long long count = list->count;
    if (count <= 0) return;
    const DeviceCopy* copies = (const DeviceCopy*)((const char*)list + list->first);
    const int blocks = (int)gridDim.x, parts = count < blocks ? blocks / (int)count : 1;
    for (long long k = blockIdx.x; k < count * parts; k += blocks) {
        const DeviceCopy copy = copies[k / parts];
        const bool wide = (((unsigned long long)copy.target | (unsigned long long)copy.source | (unsigned long long)copy.bytes) & 7) == 0;
        if (wide) copy_words<unsigned long long>(copy, (int)(k % parts), parts);
        else copy_words<unsigned>(copy, (int)(k % parts), parts);
    }
}
