// SPDX-License-Identifier: MIT
// z = P^-1 r by a partitioned inverse (plan.py): 2 P - 1 phases of dense products in float16 with float32 sums.
//
// A product of 16 rows x 32 columns is two matrix instructions, of 8 rows each. The 16 bytes of a chunk that a lane loads are the left
// factor of one as they are: their columns 0, 1 and 4, 5 its row, columns 2, 3 and 6, 7 its row eight further down. So of the right
// factor, which is the vector, four columns are used: its halves for the former and for the latter, as two numbers of float16
// (value = high + low / 2048), which keep 22 bits of it, nearly those of float32. A warp needs five instructions for 1024 bytes of
// matrix, so memory is the limit.
//
// The warps of a thread block have equal shares of the chunks of a phase, wherever in a tile they begin and end; with -DALONE whole tiles,
// since phases are short and of many tiles.
#pragma once
#include "block_group.cuh"
#ifdef HELPED
#include "helper.cuh"
#endif

#define LOW 2048.0f
constexpr int PADDING = 32;  // entries behind vectors, to which padding refers
#define LISTS 32768   // most bytes of a list that is copied to shared memory
#ifdef ALONE          // words are at hand: few registers matter more
#define CHUNKS_AT_ONCE (WARPS > 8 ? 2 : 4)
#define UNDER_WAY (WARPS > 8 ? 2 : 3)  // groups of so many chunks, for each warp
#define FEW 2         // segments that a warp loads at a time, for short lists
#define MANY 4
#else
#define CHUNKS_AT_ONCE 6
#define FEW 3
#define MANY 8        // 2304 entries in one trip through L2 with 8 warps
#endif

// 2^-k with sqrt(a) 2^-k < 1.
__device__ __forceinline__ float unit_for(double a) {
    const int k = (((__double2hiint(a) >> 20) & 0x7ff) - 1021) >> 1;  // a < 2^(2 k)
    return __int_as_float((127 - max(-120, min(120, k))) << 23);
}

// First node of the body whose b is not finite; -1: none, |b|^2 has overflowed. bad: in shared memory.
__device__ __forceinline__ int first_bad_node(const PcgBody& body, const real* b, int& bad) {
    if (threadIdx.x == 0) bad = 0x7fffffff;
    __syncthreads();
    for (int k = threadIdx.x; k < 3 * body.nodes; k += THREADS)
        if (!isfinite(b[3ll * body.first + k])) atomicMin(&bad, k / 3);
    __syncthreads();
    return bad == 0x7fffffff ? -1 : bad;
}

struct SplitVector { unsigned short *high, *low; };  // of a phase, in shared memory

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

__device__ __forceinline__ void put_halves(const SplitVector& to, int i, float v) {
    v = fminf(fmaxf(v, -6e4f), 6e4f);
    unsigned short high = half_of(v);
    to.high[i] = high;
    to.low[i] = half_of((v - of_half(high)) * LOW);
}

// Place of entry `lane` of a segment in the vector.
__device__ __forceinline__ int entry_place(int lane) {
    return (lane & ~6) | (lane & 2) << 1 | (lane & 4) >> 1;  // of each eight: 0, 1, 4, 5, 2, 3, 6, 7
}

__device__ __forceinline__ unsigned shared_address(const void* p) { return (unsigned)__cvta_generic_to_shared(p); }

__device__ __forceinline__ uint4 shared_vector_load(unsigned from) {
    uint4 v;
    asm volatile("ld.shared.v4.u32 {%0, %1, %2, %3}, [%4];" : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w) : "r"(from));
    return v;
}

// Loads 16 bytes of a matrix, for which nothing else should leave L1, from the K-th chunk behind `from`.
template <int K>
__device__ __forceinline__ uint4 chunk_load(const uint4* from) {
    uint4 v;
    asm volatile("ld.global.nc.L1::no_allocate.v4.u32 {%0, %1, %2, %3}, [%4+%5];"
                 : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w) : "l"(from), "n"(512 * K));
    return v;
}

// Loads 8 bytes of shared memory if `wanted`, else zeros, without a branch.
__device__ __forceinline__ uint2 shared_pair_load(unsigned from, bool wanted) {
    uint2 v;
    asm volatile(
        "{.reg .pred p; setp.ne.s32 p, %3, 0; mov.b32 %0, 0; mov.b32 %1, 0;\n"
        "@p ld.shared.v2.u32 {%0, %1}, [%2];}"
        : "=r"(v.x), "=r"(v.y) : "r"(from), "r"((int)wanted));
    return v;
}

// sum += a b: a of 16 rows x 16 columns, b of 16 x 8, of which four columns are used.
__device__ __forceinline__ void multiply_add(float sum[4], unsigned a0, unsigned a1, unsigned a2, unsigned a3, unsigned b0, unsigned b1) {
#if __CUDA_ARCH__ >= 800
    asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
        : "r"(a0), "r"(a1), "r"(a2), "r"(a3), "r"(b0), "r"(b1));
#endif
}

// Source of d r: before the update by alpha of this application, or (alpha = 0) after it; numbers of the exchanges.
struct ResidualSource {
    const FlagWord<float>* r;
    unsigned r_number, q_number;
    float alpha;
};

struct PartitionedInverse {
    const DevicePlan* plan;  // in shared memory
    const uint4* matrix;     // chunks of this block, of which `near` are in shared memory
    uint4* kept;
    int begin, near, planes;
    const float* scale;
    FlagWord<float> *residual, *product, *z, *formed, *solved, *contributed;
    SplitVector vector;
    float* tile_sums;        // (WARPS, 2, 16) of the tile that a warp ends, and of the one that it begins, where others have the rest
    Arena lent;              // vector and sums: nobody needs them between two applications
    const int* lists;        // of the phases: first segment (phases + 1), first tile (phases + 1), first segment that is
                             // not formed here
    const WarpSegment* segments;
    const int* where;        // (segments, 32) DevicePlan.index
    const Tile* tiles;
    int size, phases, groups;
#ifdef HELPED
    long long far;           // bytes from a word to its copy in the memory of the other device; 0: one device alone applies the inverse
#endif

    // Writes a word for the thread blocks of this device, and of the other one if `elsewhere`.
    __device__ __forceinline__ void put_for_all(FlagWord<float>& word, float v, unsigned number, [[maybe_unused]] bool elsewhere) const {
        word.put(v, number);
#ifdef HELPED
        if (elsewhere) put_far(word, far, v, number);
#endif
    }

    // at: of DevicePlan.target
    __device__ __forceinline__ void put_contribution(int at, float v, unsigned number) const {
#ifdef HELPED
        FlagWord<float>& word = contributed[at & (NEAR_READS - 1)];
        if (at & NEAR_READS) word.put(v, number);
        if (at & FAR_READS) put_far(word, far, v, number);
#else
        contributed[at].put(v, number);
#endif
    }

    // Writes a word that the solver reads.
    __device__ __forceinline__ void put_for_solver(FlagWord<float>& word, float v, unsigned number) const {
#ifdef HELPER
        put_far(word, far, v, number);
#else
        word.put(v, number);
#endif
    }

    // Copies a list into shared memory if it is short, since loads after a barrier miss L1.
    template <class T>
    static __device__ __forceinline__ const T* brought(const T* list, int count, Arena& arena) {
        T* to = count * sizeof(T) <= LISTS ? arena.take<T>(count) : nullptr;
        if (!to) return list;
        for (int k = threadIdx.x; k < count * (int)sizeof(T) / 4; k += THREADS) copy_async((int*)to + k, (const int*)list + k, 4);
        return to;
    }

    // Allocates what has to be in shared memory, which solver.PcgSolver.plan has checked to fit, and what each tile waits for.
    __device__ __forceinline__ void reserve(const DevicePlan* shared_plan, int index, Arena& arena) {
        plan = shared_plan;
        size = plan->size; phases = plan->phases; groups = plan->groups;
        lent = {arena.next, arena.next};
        vector.high = arena.take<unsigned short>(shared_plan->entries);
        vector.low = arena.take<unsigned short>(shared_plan->entries);
#ifndef ALONE
        tile_sums = arena.take<float>(16 * 2 * WARPS);
#endif
        lent.end = arena.next;
        const BlockRanges part = plan->block_ranges[index];
        lists = brought(plan->lists + index * (3 * phases + 2), 3 * phases + 2, arena);
        tiles = brought(plan->tiles + part.tile, part.tiles, arena);
    }

#ifdef ALONE
    // Moves words into shared memory if they fit.
    static __device__ __forceinline__ void words(FlagWord<float>*& at, int count, Arena& arena) {
        FlagWord<float>* found = arena.take<FlagWord<float>>(count);
        if (found) at = found;
    }
#endif

    __device__ __forceinline__ void set_up(const PcgBody& body, int index, Arena& arena) {
        scale = body.scale; planes = body.planes;
        residual = body.residual; product = body.product; z = body.z;
        formed = body.formed; solved = body.solved; contributed = body.contributed;
#ifdef ALONE
        words(residual, size + PADDING, arena);
        words(z, size + PADDING, arena);
        words(solved, size + PADDING, arena);
        words(contributed, plan->contributions, arena);
        words(formed, size + PADDING, arena);
#endif
        const BlockRanges part = plan->block_ranges[index];
        segments = brought(plan->segments + part.segment, part.segments, arena);
        where = brought(plan->index + 32ll * part.segment, 32 * part.segments, arena);
        begin = part.chunk;
        matrix = body.matrix + 32ll * begin;
        near = (int)((arena.end - arena.next) / 512);  // chunks that fit into the rest of shared memory
        near = near < part.chunks ? near : part.chunks;
        kept = arena.take<uint4>(32ll * near);
        copies_begin();
    }

    __device__ __forceinline__ void fetch() const {
        for (int k = threadIdx.x; k < 32 * near; k += THREADS) copy_async(kept + k, matrix + k, 16);
        copies_begin();
    }

    // Loads the vector of a phase: entries that this block forms, then those of other blocks. There are no branches between
    // loads, so that their latencies overlap.
    __device__ __forceinline__ void gather(int phase, const ResidualSource& from, unsigned number, float unit) const {
        const int warp = threadIdx.x / 32, first = lists[phase], last = lists[phase + 1];
        const int middle = phase < groups ? lists[2 * phases + 2 + phase] : first, formed_here = middle - first;
        if (phase == 0) {
            if (formed_here <= FEW * WARPS) residual_segments<FEW>(first + warp, middle, from, number, unit);
            else for (int k = first + warp; k < middle; k += MANY * WARPS) residual_segments<MANY>(k, middle, from, number, unit);
#ifdef ALONE
        } else {
            for (int k = first + warp; k < middle; k += WARPS) reduced_segments<1, 6>(k, middle, from, number, unit);
        }
#else
        } else if (formed_here > FEW * WARPS) {
            for (int k = first + warp; k < middle; k += 2 * WARPS) reduced_segments<2, 6>(k, middle, from, number, unit);
        } else if (formed_here > WARPS) {
            reduced_segments<FEW, 4>(first + warp, middle, from, number, unit);
        } else {
            reduced_segments<1, 12>(first + warp, middle, from, number, unit);
        }
#endif
        if (last - middle <= FEW * WARPS) solved_segments<FEW>(middle + warp, last, number, unit);
        else for (int k = middle + warp; k < last; k += MANY * WARPS) solved_segments<MANY>(k, last, number, unit);
    }

    // Segments of the first phase, to which nothing has contributed.
    template <int N>
    __device__ __forceinline__ void residual_segments(int at, int last, const ResidualSource& from, unsigned number, float unit) const {
        if (at >= last) return;
        const int lane = threadIdx.x % 32;
        FlagWord<float> r[N], q[N];
        float rk[N], qk[N];
        bool all;
        unsigned spins = 0;
        do {
#pragma unroll
            for (int k = 0; k < N; ++k) {
                const int i = segments[min(at + k * WARPS, last - 1)].from + lane;
                r[k] = from.r[i].load();
#ifdef ALONE  // there is no update to be applied
                q[k] = r[k];
#else
                q[k] = product[i].load();
#endif
            }
            all = true;
#pragma unroll
            for (int k = 0; k < N; ++k) {
                const bool valid = lane < segments[min(at + k * WARPS, last - 1)].keep >> 1;
                all &= (r[k].unpack(rk[k], from.r_number) & (q[k].unpack(qk[k], from.q_number) | from.alpha == 0)) | !valid;
                rk[k] = valid ? rk[k] : 0;
                qk[k] = valid && from.alpha != 0 ? qk[k] : 0;
            }
        } while (keep_polling(!all, spins));
#pragma unroll
        for (int k = 0; k < N; ++k)
            if (at + k * WARPS < last) put(segments[at + k * WARPS], rk[k] - from.alpha * qk[k], number, unit);
    }

    __device__ __forceinline__ void put(const WarpSegment& segment, float v, unsigned number, float unit) const {
        const int lane = threadIdx.x % 32;
        put_halves(vector, segment.to + entry_place(lane), unit * v);
        if (segment.keep & 1) put_for_all(formed[segment.from + lane], v, number, segment.kind != 0);
    }

    // Segments of the later phases up to the top: residual minus contributions.
    template <int N, int M>
    __device__ __forceinline__ void reduced_segments(int at, int last, const ResidualSource& from, unsigned number, float unit) const {
        if (at >= last) return;
        const int lane = threadIdx.x % 32;
        int low[N], high[N], most = 0;
        FlagWord<float> r[N];
        float v[N];
#pragma unroll
        for (int k = 0; k < N; ++k) {
            const int p = min(at + k * WARPS, last - 1);
            const unsigned slots = where[32 * p + lane];
            low[k] = slots & 0xffffff;
            high[k] = low[k] + (slots >> 24);
            r[k] = from.r[segments[p].from + lane].load();
            v[k] = 0;
        }
#pragma unroll
        for (int k = 0; k < N; ++k) most = max(most, high[k] - low[k]);
        for (int m = 0; m < most; m += M) {
            FlagWord<float> c[N][M];
            float ck[N][M];
            bool all;
            unsigned spins = 0;
            do {
#pragma unroll
                for (int k = 0; k < N; ++k)
#pragma unroll
                    for (int j = 0; j < M; ++j) c[k][j] = contributed[min(low[k] + m + j, max(high[k] - 1, 0))].load();
                all = true;
#pragma unroll
                for (int k = 0; k < N; ++k)
#pragma unroll
                    for (int j = 0; j < M; ++j) all &= c[k][j].unpack(ck[k][j], number) | (low[k] + m + j >= high[k]);
            } while (keep_polling(!all, spins));
#pragma unroll
            for (int k = 0; k < N; ++k)
#pragma unroll
                for (int j = 0; j < M; ++j) v[k] -= low[k] + m + j < high[k] ? ck[k][j] : 0;
        }
#pragma unroll
        for (int k = 0; k < N; ++k) {
            if (at + k * WARPS >= last) continue;
            const WarpSegment& segment = segments[at + k * WARPS];
            const bool valid = lane < segment.keep >> 1;
            float rk = 0;
            for (unsigned spins = 0; keep_polling(valid && !r[k].unpack(rk, from.r_number), spins);) r[k] = from.r[segment.from + lane].load();
            put(segment, valid ? rk + v[k] : 0, number, unit);
        }
    }

    // Segments that were formed (earlier, or in this phase by another block) or solved.
    template <int N>
    __device__ __forceinline__ void solved_segments(int at, int last, unsigned number, float unit) const {
        if (at >= last) return;
        const int lane = threadIdx.x % 32;
        const FlagWord<float>* word[N];
        FlagWord<float> w[N];
        float v[N];
        bool all;
#pragma unroll
        for (int k = 0; k < N; ++k) {
            const int p = min(at + k * WARPS, last - 1);
            word[k] = (segments[p].kind == 1 ? formed : solved) + where[32 * p + lane];
        }
        unsigned spins = 0;
        do {
#pragma unroll
            for (int k = 0; k < N; ++k) w[k] = word[k]->load();
            all = true;
#pragma unroll
            for (int k = 0; k < N; ++k) {
                const bool valid = lane < segments[min(at + k * WARPS, last - 1)].keep >> 1;
                all &= w[k].unpack(v[k], number) | !valid;
                v[k] = valid ? v[k] : 0;
            }
        } while (keep_polling(!all, spins));
#pragma unroll
        for (int k = 0; k < N; ++k)
            if (at + k * WARPS < last) put_halves(vector, segments[at + k * WARPS].to + entry_place(lane), unit * v[k]);
    }

    // Address of what this lane has of the vector's first 32 entries from x on.
    __device__ __forceinline__ unsigned vector_address(int x) const {
        const int lane = threadIdx.x % 32;
        return shared_address((lane & 4 ? vector.low : vector.high) + x + 8 * (lane % 4) + (lane & 8 ? 4 : 0));
    }

    // Row `lane` (of sixteen) of what a warp has summed up, in lanes 0 to 15.
    static __device__ __forceinline__ float row_of(const float sum[2][4]) {
        const int lane = threadIdx.x % 32;  // lanes 4 r, 4 r + 1 have halves of row r, the two behind them of row r + 8
        const bool lower = lane & 2;
        const float first = (lower ? sum[1][0] : sum[0][0]) + (lower ? sum[1][1] : sum[0][1]) / LOW;
        const float second = (lower ? sum[1][2] : sum[0][2]) + (lower ? sum[1][3] : sum[0][3]) / LOW;
        float part = lane & 1 ? second : first;
        part += __shfl_xor_sync(ALL, part, 1);
        return __shfl_sync(ALL, part, 4 * (lane % 8) + (lane & 8 ? 2 : 0));
    }

#ifdef ALONE
    // Chunks of a tile on their way to a warp: of its upper eight rows, and of its lower ones.
    struct Group {
        uint4 upper[CHUNKS_AT_ONCE], lower[CHUNKS_AT_ONCE];
        int phase, x, count;  // of the tile; first entry of the vector; chunks
        int rows, out;        // of a tile's last group: its rows, else 0; where this lane's row goes
        float scale;          // likewise: its scale
        bool last;            // of a plane
    };

    // The groups of a warp, one after another through all phases: UNDER_WAY of them are on their way while one is multiplied, also
    // from one phase to the next.
    struct Stream {
        Group group[UNDER_WAY];
        int turn, phase, job, plane, at;
    };

    __device__ __forceinline__ void open(Stream& s) const {
        s.turn = s.phase = s.plane = s.at = 0;
        s.job = threadIdx.x / 32;
#pragma unroll
        for (int n = 0; n < UNDER_WAY; ++n) {
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k) s.group[n].upper[k] = s.group[n].lower[k] = make_uint4(0, 0, 0, 0);
            ask(s, s.group[n]);
        }
    }

    template <int K>
    static __device__ __forceinline__ void far_chunks(Group& g, const uint4* upper, const uint4* lower) {
        if constexpr (K < CHUNKS_AT_ONCE) {
            if (K >= g.count) return;
            g.upper[K] = chunk_load<K>(upper);
            g.lower[K] = chunk_load<K>(lower);
            far_chunks<K + 1>(g, upper, lower);
        }
    }

    __device__ __forceinline__ void ask(Stream& s, Group& g) const {
        while (s.phase < phases && s.job >= lists[phases + 2 + s.phase] - lists[phases + 1 + s.phase]) {
            ++s.phase;
            s.job = threadIdx.x / 32;
        }
        g.phase = s.phase;
        if (s.phase == phases) return;
        const Tile tile = tiles[lists[phases + 1 + s.phase] + s.job];
        const int from = tile.chunk - begin + s.plane * tile.chunks + s.at, lane = threadIdx.x % 32;
        g.count = min(CHUNKS_AT_ONCE, tile.chunks - s.at);
        g.x = tile.x + 32 * s.at;
        g.rows = 0;
        const int second = tile.rows > 8 ? tile.chunks * planes : 0;  // rows that a tile has not are not used
        if (from + second + g.count <= near) {
            const unsigned a = shared_address(kept + lane) + 512 * from, b = a + 512 * second;
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k)
                if (k < g.count) {
                    g.upper[k] = shared_vector_load(a + 512 * k);
                    g.lower[k] = shared_vector_load(b + 512 * k);
                }
        } else {
            const uint4* a = matrix + (32 * from + lane);
            far_chunks<0>(g, a, a + 32 * second);
        }
        s.at += CHUNKS_AT_ONCE;
        g.last = s.at >= tile.chunks;
        if (!g.last) return;
        s.at = 0;
        if (++s.plane < planes) return;
        g.rows = tile.rows;
        g.out = tile.out + min(lane, tile.rows - 1);
        if (s.phase < groups - 1) g.out = __ldg(plan->target + g.out);
        else g.scale = __ldg(scale + g.out);
        s.plane = 0;
        s.job += WARPS;
    }

    // Products of a phase; returns this thread's part of z . r.
    __device__ __forceinline__ double multiply(int phase, const ResidualSource& from, unsigned number, float unit, Stream& s) const {
        const int lane = threadIdx.x % 32;
        const bool forward = phase < groups - 1;
        const float back = 1 / unit;
        float sum[2][4] = {}, total = 0, weight = 1;
        double zr = 0;
        auto take = [&](Group& g) {
            const unsigned from_here = vector_address(g.x);
            uint2 v[CHUNKS_AT_ONCE];  // zero behind the last chunk, where one of an earlier group is left
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k) v[k] = shared_pair_load(from_here + 64 * k, k < g.count);
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k) {
                const uint4 m = g.upper[k], n = g.lower[k];
                multiply_add(sum[0], m.x, m.y, m.z, m.w, v[k].x, v[k].y);
                multiply_add(sum[1], n.x, n.y, n.z, n.w, v[k].x, v[k].y);
            }
            const bool last = g.last;
            const int rows = g.rows, i = g.out;
            const float d = g.scale;
            ask(s, g);
            if (!last) return;
            total += weight * row_of(sum);
            weight /= LOW;
            for (int k = 0; k < 4; ++k) sum[0][k] = sum[1][k] = 0;
            if (rows == 0) return;
            const float value = back * total;
            total = 0;
            weight = 1;
            if (lane >= rows) return;
            if (forward) {
                contributed[i].put(value, number);
                return;
            }
            solved[i].put(value, number);
            z[i].put(d * value, number);
            if (d == 0) return;  // padding
            zr += (double)value * from.r[i].value;
        };
        for (;;) {
            if (s.turn == 0) {
                if (s.group[0].phase != phase) break;
                take(s.group[0]);
                __syncwarp();
                s.turn = 1;
            }
            if (s.turn == 1) {
                if (s.group[1].phase != phase) break;
                take(s.group[1]);
                __syncwarp();
                s.turn = UNDER_WAY > 2 ? 2 : 0;
            }
            if constexpr (UNDER_WAY > 2) {
                if (s.group[2].phase != phase) break;
                take(s.group[2]);
                __syncwarp();
                s.turn = 0;
            }
        }
        return zr;
    }
#else
    // Chunks of all tiles of a phase, side by side; which of them a warp has: [share(w, total), share(w + 1, total)).
    __device__ __forceinline__ int chunks_of(int first, int count) const {
        return count > 0 ? tiles[first + count - 1].before + tiles[first + count - 1].chunks : 0;
    }
    static __device__ __forceinline__ int share(int warp, int total) { return total * warp / WARPS; }

    // The tile in which chunk `at` of a phase lies.
    __device__ __forceinline__ int tile_at(int first, int count, int at) const {
        int found = first - 1;
        for (int k = threadIdx.x % 32; k - (int)threadIdx.x % 32 < count; k += 32)
            found += __popc(__ballot_sync(ALL, k < count && tiles[first + min(k, count - 1)].before <= at));
        return found;
    }

    // Sum of the pieces of a tile that this warp began and later warps end, at chunk `end` of the phase.
    __device__ __forceinline__ float joined(int warp, int total, int end) const {
        const int lane = threadIdx.x % 32;
        float value = tile_sums[16 * (2 * warp + 1) + lane];
        for (int w = warp + 1; w < WARPS && share(w, total) < end; ++w)
            if (share(w + 1, total) > share(w, total)) value += tile_sums[16 * 2 * w + lane];
        return value;
    }

    // Sums over chunks [from, to) of this block's storage, and over those `second` further on, of the next eight rows; the
    // vector begins at `x`.
    template <bool NEAR>
    __device__ __forceinline__ void accumulate(int from, int to, int second, int x, float sum[2][4]) const {
        const int lane = threadIdx.x % 32;
        const unsigned half = vector_address(x), a = shared_address(kept + lane);
        const uint4* far = matrix + lane;
        for (int at = from; at < to; at += CHUNKS_AT_ONCE) {
            uint4 m[CHUNKS_AT_ONCE], n[CHUNKS_AT_ONCE];
            uint2 v[CHUNKS_AT_ONCE];
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k) {
                const int c = min(at + k, to - 1);
                m[k] = NEAR ? shared_vector_load(a + 512 * c) : __ldg(far + 32ll * c);
                n[k] = NEAR ? shared_vector_load(a + 512 * (c + second)) : __ldg(far + 32ll * (c + second));
                v[k] = shared_pair_load(half + 64 * (c - from), at + k < to);
            }
#pragma unroll
            for (int k = 0; k < CHUNKS_AT_ONCE; ++k) {
                multiply_add(sum[0], m[k].x, m[k].y, m[k].z, m[k].w, v[k].x, v[k].y);
                multiply_add(sum[1], n[k].x, n[k].y, n[k].z, n[k].w, v[k].x, v[k].y);
            }
        }
    }

    // Row `lane` (of sixteen) of a tile's product over its chunks [low, high), in lanes 0 to 15.
    __device__ __forceinline__ float product_of(const Tile& tile, int low, int high) const {
        const int second = tile.rows > 8 ? tile.chunks * planes : 0, x = tile.x;
        float total = 0, weight = 1;
        for (int plane = 0; plane < planes; ++plane, weight /= LOW) {
            float sum[2][4] = {};
            const int from = tile.chunk - begin + plane * tile.chunks + low, to = from + high - low;
            const int kept_to = near - second, middle = to < kept_to ? to : from > kept_to ? from : kept_to;
            accumulate<true>(from, middle, second, x + 32 * low, sum);
            accumulate<false>(middle, to, second, x + 32 * (low + middle - from), sum);
            total += weight * row_of(sum);
        }
        return total;
    }

    // Computes the products of a phase; returns this thread's part of z . r. The vector has been read by all threads. unit: factor by
    // which it is scaled.
    __device__ __forceinline__ double multiply(int phase, const ResidualSource& from, unsigned number, float unit) const {
        const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
        const int first = lists[phases + 1 + phase], count = lists[phases + 2 + phase] - first;
        const bool forward = phase < groups - 1;
        const float back = 1 / unit;
        double zr = 0;
        int i = 0;
        float d = 0;
        bool elsewhere = false;  // -DHELPED: the other device reads the result
        FlagWord<float> r, q;  // of d r, for z . r
        auto look_up = [&](const Tile& tile, int row) {  // loads before the product, whose latency hides theirs
            i = tile.out + row;
            if (forward) {
                i = plan->target[i];
                return;
            }
#ifdef HELPED
            elsewhere = tile.elsewhere;
#endif
            d = scale[i];
            r = from.r[i].load();
            if (from.alpha != 0) q = product[i].load();
        };
        auto finish = [&](float value) {
            if (forward) {
                put_contribution(i, value, number);
                return;
            }
            put_for_all(solved[i], value, number, elsewhere);
            put_for_solver(z[i], d * value, number);
            if (d == 0) return;  // padding
            float ri, qi = 0;
            for (unsigned spins = 0; keep_polling(!r.unpack(ri, from.r_number), spins);) r = from.r[i].load();
            if (from.alpha != 0)
                for (unsigned spins = 0; keep_polling(!q.unpack(qi, from.q_number), spins);) q = product[i].load();
            zr += (double)value * (ri - from.alpha * qi);
        };
        const int total = chunks_of(first, count), low = share(warp, total), high = share(warp + 1, total);
        int open = 0;  // end of a tile that this warp begins and others end
        for (int next = low, at = tile_at(first, count, low); next < high; ++at) {
            __syncwarp();  // some lanes may still be in `finish`
            const Tile tile = tiles[at];
            const int begins = next - tile.before, end = tile.before + tile.chunks;
            const int ends = min(tile.chunks, high - tile.before);
            const bool opens = begins == 0, whole = opens && ends == tile.chunks;
            if (opens && lane < tile.rows) look_up(tile, lane);
            const float value = product_of(tile, begins, ends);
            next = tile.before + ends;
            if (lane >= tile.rows) continue;
            if (whole) finish(back * value);
            else tile_sums[16 * (2 * warp + opens) + lane] = value;
            if (opens && !whole) open = end;
        }
        __syncthreads();  // the vector has been read, too
        if (open > 0) finish(back * joined(warp, total, open));
        return zr;
    }
#endif
};
