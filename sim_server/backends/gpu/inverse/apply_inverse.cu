// SPDX-License-Identifier: MIT
// z = P^-1 r by a partitioned inverse (plan.py), phase by phase, a launch or two for each. For the check of a factor, beside the steps:
// the solver has a text of its own, which is many times faster (partitioned_inverse.cuh). GPU only.

struct Tile {     // 8 rows of the matrix of a part
    int chunk, chunks;    // the first one in the storage; their number
    int inside, start;    // chunks that multiply s from packed position `start` on
    int boundary, out;    // the others multiply y at boundary[boundary ..]; where the 8 sums go
};

__device__ __forceinline__ float half_at(unsigned word, int upper) {
    float x;
    unsigned short h = upper ? word >> 16 : word & 0xffff;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(h));
    return x;
}

// s = D r less what phases before have contributed.
extern "C" __global__ void form(int n, const float* scale, const float* r, const int* slot_start, const int* slots, const float* contributed, float* s) {
    for (int i = blockIdx.x * blockDim.x + threadIdx.x; i < n; i += gridDim.x * blockDim.x) {
        float v = scale[i] * r[i];
        for (int k = slot_start[i]; k < slot_start[i + 1]; k++) v -= contributed[slots[k]];
        s[i] = v;
    }
}

// Products of the tiles of a phase, one by each warp. Eight numbers of a row are with each thread, four of which have a row of a chunk.
extern "C" __global__ void product(const Tile* tiles, int count, const uint4* matrix, int planes, const float* s, const int* boundary,
                                   const float* y, float* to) {
    const int lane = threadIdx.x % 32, column = lane % 4 * 8, warps = blockDim.x / 32;
    for (int t = blockIdx.x * warps + threadIdx.x / 32; t < count; t += gridDim.x * warps) {
        const Tile tile = tiles[t];
        float sum = 0;
        for (int c = 0; c < tile.chunks; c++) {
            float x[8];
            if (c < tile.inside)
                for (int e = 0; e < 8; e++) x[e] = s[tile.start + 32 * c + column + e];
            else
                for (int e = 0; e < 8; e++) x[e] = y[boundary[tile.boundary + 32 * (c - tile.inside) + column + e]];
            for (int plane = 0; plane < planes; plane++) {
                const uint4 m = matrix[32ll * (tile.chunk + plane * tile.chunks + c) + lane];
                const unsigned word[4] = {m.x, m.y, m.z, m.w};
                float part = 0;
#pragma unroll
                for (int e = 0; e < 8; e++) part += half_at(word[e / 2], e % 2) * x[e];
                sum += plane ? part / 2048.f : part;
            }
        }
        sum += __shfl_xor_sync(0xffffffffu, sum, 1);
        sum += __shfl_xor_sync(0xffffffffu, sum, 2);
        if (lane % 4 == 0) to[tile.out + lane / 4] = sum;
    }
}

// z = D y
extern "C" __global__ void scale_back(int n, const float* scale, const float* y, float* z) {
    for (int i = blockIdx.x * blockDim.x + threadIdx.x; i < n; i += gridDim.x * blockDim.x) z[i] = scale[i] * y[i];
}
