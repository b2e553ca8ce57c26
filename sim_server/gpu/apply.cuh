// SPDX-License-Identifier: MIT
// z = P^-1 r by an inverse in parts (plan.py): 2 P - 1 phases of dense products in float16 with float32 sums.
//
// A product of 8 rows x 32 columns is two matrix instructions. The vector is their left factor, split into two float16
// (value = high + low / 2048): 22 bits of it count, nearly as many as float32 has. So a warp needs four instructions for 512
// bytes of matrix, and memory is the only limit.
#pragma once
#include "team.cuh"

#define LOW 2048.0f
#ifndef CHUNKS_AT_ONCE
#define CHUNKS_AT_ONCE 4
#endif
#define TILE_SUMS 64  // jobs of a phase that share tiles, at most

struct Vector { unsigned short *high, *low; };  // of a phase, in shared memory

__device__ __forceinline__ unsigned short half_of(float v) {
    unsigned short h;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(h) : "f"(v));
    return h;
}
__device__ __forceinline__ float of_half(unsigned short h) {
    float v;
    asm("cvt.f32.f16 %0, %1;" : "=f"(v) : "h"(h));
    return v;
}

__device__ __forceinline__ void put_halves(const Vector& to, int i, float v) {
    v = fminf(fmaxf(v, -6e4f), 6e4f);
    unsigned short high = half_of(v);
    to.high[i] = high;
    to.low[i] = half_of((v - of_half(high)) * LOW);
}

__device__ __forceinline__ void multiply_add(float sum[4], unsigned a0, unsigned a2, unsigned b0, unsigned b1) {
#if __CUDA_ARCH__ >= 800
    asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
        : "r"(a0), "r"(0), "r"(a2), "r"(0), "r"(b0), "r"(b1));
#endif
}

// Where d r is found before the update by alpha of this application, or after it, and the numbers of the exchanges.
struct Residual {
    const Word<float>* r;
    unsigned r_number, q_number;
    float alpha;
};

struct Inverse {
    const Plan* plan;             // in shared memory
    const uint4* matrix;          // chunks of this block, of which `near` are in shared memory
    const uint4* kept;
    int begin, near, planes;
    const float* scale;
    Word<float> *residual, *product, *z, *formed, *solved, *given;
    Vector vector;
    float* tile_sums;             // (TILE_SUMS, 8)
    const int* lists;             // of the phases: first piece (phases + 1), first tile (phases + 1), warps that share a tile
    const Piece* pieces;
    const Tile* tiles;
    int size, phases, groups;

    // A list into shared memory if it is short: loads after a barrier miss L1.
    template <class T>
    static __device__ __forceinline__ const T* brought(const T* list, int count, Arena& arena) {
        T* to = count * sizeof(T) <= 16384 ? arena.take<T>(count) : nullptr;
        if (!to) return list;
        for (int k = threadIdx.x; k < count * (int)sizeof(T) / 4; k += THREADS) copy_async((int*)to + k, (const int*)list + k, 4);
        return to;
    }

    __device__ __forceinline__ void set_up(const Body& body, const Plan* shared_plan, int index, Arena& arena) {
        plan = shared_plan;
        size = plan->size; phases = plan->phases; groups = plan->groups;
        scale = body.scale; planes = body.planes;
        residual = body.residual; product = body.product; z = body.z;
        formed = body.formed; solved = body.solved; given = body.given;
        const Part part = plan->parts[index];
        vector.high = arena.take<unsigned short>(plan->entries);
        vector.low = arena.take<unsigned short>(plan->entries);
        tile_sums = arena.take<float>(8 * TILE_SUMS);
        lists = brought(plan->lists + index * (3 * phases + 2), 3 * phases + 2, arena);
        pieces = brought(plan->pieces + part.piece, part.pieces, arena);
        tiles = brought(plan->tiles + part.tile, part.tiles, arena);
        begin = part.chunk;
        matrix = body.matrix + 32ll * begin;
        near = (int)((arena.end - arena.next) / 512);  // as many chunks as fit into what is left of shared memory
        near = near < part.chunks ? near : part.chunks;
        uint4* to = arena.take<uint4>(32ll * near);
        for (int k = threadIdx.x; k < 32 * near; k += THREADS) copy_async(to + k, matrix + k, 16);
        kept = to;
        copies_begin();
    }

    // Brings together the vector of a phase. No branches between loads: they travel together.
    __device__ __forceinline__ void gather(int phase, const Residual& from, unsigned number, float unit) const {
        const int first = lists[phase] + (int)threadIdx.x / 32, last = lists[phase + 1];
        for (int at = first; at < last; at += AT_ONCE * WARPS) {
            if (phase == 0) residual_pieces(at, last, from, number, unit);
            else if (phase >= groups) solved_pieces(at, last, number, unit);
            else for (int k = at; k < min(at + AT_ONCE * WARPS, last); k += WARPS) reduced_piece(k, from, number, unit);
        }
    }

    // Of the first phase: nothing has contributed yet.
    __device__ __forceinline__ void residual_pieces(int at, int last, const Residual& from, unsigned number, float unit) const {
        const int lane = threadIdx.x % 32;
        Word<float> r[AT_ONCE], q[AT_ONCE];
        float rk[AT_ONCE], qk[AT_ONCE];
        bool all;
        do {
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const int i = pieces[min(at + k * WARPS, last - 1)].from + lane;
                r[k] = from.r[i].seen();
                q[k] = product[i].seen();
            }
            all = true;
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const bool valid = lane < pieces[min(at + k * WARPS, last - 1)].keep >> 1;
                all &= (r[k].is(rk[k], from.r_number) & (q[k].is(qk[k], from.q_number) | from.alpha == 0)) | !valid;
                rk[k] = valid ? rk[k] : 0;
                qk[k] = valid && from.alpha != 0 ? qk[k] : 0;
            }
        } while (!all);
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k)
            if (at + k * WARPS < last) put(pieces[at + k * WARPS], rk[k] - from.alpha * qk[k], number, unit);
    }

    __device__ __forceinline__ void put(const Piece& piece, float v, unsigned number, float unit) const {
        const int lane = threadIdx.x % 32;
        put_halves(vector, piece.to + lane, unit * v);
        if (piece.keep & 1) formed[piece.from + lane].put(v, number);
    }

    // Of the phases up to the top: what has been contributed comes off.
    __device__ __forceinline__ void reduced_piece(int at, const Residual& from, unsigned number, float unit) const {
        const int lane = threadIdx.x % 32;
        const Piece piece = pieces[at];
        const bool valid = lane < piece.keep >> 1;
        const int i = piece.from + lane, low = plan->slot_start[i], high = plan->slot_start[i + 1];
        Word<float> r = from.r[i].seen();
        float v = 0, sum = 0;
        for (int k = low; k < high; k += AT_ONCE) {
            Word<float> c[AT_ONCE];
            float ck[AT_ONCE];
            bool all;
            do {
#pragma unroll
                for (int m = 0; m < AT_ONCE; ++m) c[m] = given[min(k + m, high - 1)].seen();
                all = true;
#pragma unroll
                for (int m = 0; m < AT_ONCE; ++m) all &= c[m].is(ck[m], number);
            } while (!all);
#pragma unroll
            for (int m = 0; m < AT_ONCE; ++m) sum += k + m < high ? ck[m] : 0;
        }
        while (valid && !r.is(v, from.r_number)) r = from.r[i].seen();
        put(piece, valid ? v - sum : 0, number, unit);
    }

    // Of the phases after the top: what was formed on the way there, and what is solved.
    __device__ __forceinline__ void solved_pieces(int at, int last, unsigned number, float unit) const {
        const int lane = threadIdx.x % 32;
        const Word<float>* word[AT_ONCE];
        Word<float> w[AT_ONCE];
        float v[AT_ONCE];
        bool all;
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            const Piece piece = pieces[min(at + k * WARPS, last - 1)];
            const int i = piece.from + lane, j = plan->boundary[piece.kind == 1 ? 0 : i];
            word[k] = piece.kind == 1 ? formed + i : solved + j;
        }
        do {
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) w[k] = word[k]->seen();
            all = true;
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const bool valid = lane < pieces[min(at + k * WARPS, last - 1)].keep >> 1;
                all &= w[k].is(v[k], number) | !valid;
                v[k] = valid ? v[k] : 0;
            }
        } while (!all);
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k)
            if (at + k * WARPS < last) put_halves(vector, pieces[at + k * WARPS].to + lane, unit * v[k]);
    }

    // Sums over chunks [from, to) of this block's storage; the vector begins at `x`. Four chains of matrix instructions.
    template <bool NEAR>
    __device__ __forceinline__ void accumulate(int from, int to, int x, float sum[4][4]) const {
        const int lane = threadIdx.x % 32;
        const unsigned short* half = (lane & 4 ? vector.low : vector.high) + x + 8 * (lane % 4);
        const uint4* a = (NEAR ? kept : matrix) + lane;
        for (int at = from; at < to; at += CHUNKS_AT_ONCE) {
            uint4 m[CHUNKS_AT_ONCE], v[CHUNKS_AT_ONCE];
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k) {
                const int c = min(at + k, to - 1);
                m[k] = NEAR ? a[32 * c] : __ldg(a + 32ll * c);
                v[k] = *(const uint4*)(half + 32 * (c - from));
            }
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k) {
                const bool here = lane < 8 && at + k < to;  // the other rows of the left factor are zero
                multiply_add(sum[2 * k % 4], here ? v[k].x : 0, here ? v[k].y : 0, m[k].x, m[k].y);
                multiply_add(sum[2 * k % 4 + 1], here ? v[k].z : 0, here ? v[k].w : 0, m[k].z, m[k].w);
            }
        }
    }

    // Row `lane` (of eight) of a tile's product over its chunks [low, high), in lanes 0 to 7.
    __device__ __forceinline__ float product_of(const Tile& tile, int low, int high) const {
        const int lane = threadIdx.x % 32;
        float total = 0, weight = 1;
        for (int plane = 0; plane < planes; ++plane, weight /= LOW) {
            float sum[4][4] = {};
            int from = tile.chunk - begin + plane * tile.chunks + low, to = from + high - low;
            int middle = to < near ? to : from > near ? from : near;
            accumulate<true>(from, middle, tile.x + 32 * low, sum);
            accumulate<false>(middle, to, tile.x + 32 * (low + middle - from), sum);
            for (int k = 0; k < 2; ++k) {
                sum[0][k] = (sum[0][k] + sum[1][k]) + (sum[2][k] + sum[3][k]);
                sum[0][k] += __shfl_down_sync(ALL, sum[0][k], 4) / LOW;  // lane t: rows 2 t, 2 t + 1
            }
            float even = __shfl_sync(ALL, sum[0][0], lane / 2), odd = __shfl_sync(ALL, sum[0][1], lane / 2);
            total += weight * (lane % 2 ? odd : even);
        }
        return total;
    }

    // The products of a phase; returns this thread's part of z . r. unit: what the vector was multiplied by.
    __device__ __forceinline__ double multiply(int phase, const Residual& from, unsigned number, float unit) const {
        const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
        const int first = lists[phases + 1 + phase], count = lists[phases + 2 + phase] - first;
        const int parts = lists[2 * phases + 2 + phase];
        const bool forward = phase < groups - 1;
        const float back = 1 / unit;
        double zr = 0;
        int i = 0;
        float d = 0;
        Word<float> r, q;  // of d r, for z . r
        auto look_up = [&](const Tile& tile, int row) {  // before the product: these loads take as long
            i = tile.out + row;
            if (forward) {
                i = plan->target[i];
                return;
            }
            d = scale[i];
            r = from.r[i].seen();
            if (from.alpha != 0) q = product[i].seen();
        };
        auto finish = [&](float value) {
            if (forward) {
                given[i].put(value, number);
                return;
            }
            solved[i].put(value, number);
            z[i].put(d * value, number);
            if (d == 0) return;  // padding
            float ri, qi = 0;
            while (!r.is(ri, from.r_number)) r = from.r[i].seen();
            if (from.alpha != 0)
                while (!q.is(qi, from.q_number)) q = product[i].seen();
            zr += (double)value * (ri - from.alpha * qi);
        };
        const int row = threadIdx.x;
        if (parts > 1 && row < 8 * count) look_up(tiles[first + row / 8], row % 8);
        for (int job = warp; job < count * parts; job += WARPS) {
            const int at = parts > 1 ? job / parts : job, part = job - at * parts;
            const Tile tile = tiles[first + at];
            if (parts == 1 && lane < 8) look_up(tile, lane);
            const float value = product_of(tile, tile.chunks * part / parts, tile.chunks * (part + 1) / parts);
            if (lane >= 8) continue;
            if (parts > 1) tile_sums[8 * job + lane] = value;
            else finish(back * value);
        }
        if (parts > 1) {
            __syncthreads();
            if (row < 8 * count) {
                float value = 0;
                for (int k = 0; k < parts; ++k) value += tile_sums[8 * (row / 8 * parts + k) + row % 8];
                finish(back * value);
            }
        }
        return zr;
    }
};
