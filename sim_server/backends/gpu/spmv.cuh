// SPDX-License-Identifier: MIT
// Matrix-vector product with the rows of A of one thread block, and the block's part of the vectors. A block keeps the values of
// all nodes that its rows read (the halo, own nodes first), so that it forms a search direction itself where it is used.
#pragma once
#include "block_group.cuh"
#ifdef CUTS
#include "cut_nodes.cuh"
#endif
#ifdef HELPED
#include "helper.cuh"
#endif
#include "invert3.cuh"

#ifndef TOGETHER
#define TOGETHER 3                   // rows that a warp multiplies at a time
#endif
#ifndef SLAB_ROWS
#define SLAB_ROWS 4                  // likewise in a slab
#endif
#define SLAB (SLAB_ROWS * WARPS)     // rows that are copied to shared memory at a time if not all fit
#define SLABS 2                      // buffers of a slab, used in turns
#define SLAB_BLOCKS (17 * SLAB)      // most blocks of A in a slab, unless there is less room; a slab with more is read from global memory

#ifdef ALONE
// A is symmetric to the bit, so that the blocks on and above its diagonal are enough: they are kept in shared memory, all of them or
// those of a window of rows that moves down. Each block of A has a word: 65536 times the rank of the block that is kept, among
// those of the body; whether it is transposed; its column.
#ifndef WARP_ROWS
#define WARP_ROWS (WARPS > 8 ? 4 : 8)    // rows that a warp multiplies at a time
#endif
#define ROW_LANES (32 / WARP_ROWS)       // lanes that share a row: 4 or 8
#define WINDOW_ROWS (WARP_ROWS * WARPS)  // of a slab of the window
#define WINDOW_BLOCKS (17 * WINDOW_ROWS) // most blocks of A in it
#define AHEAD 1                      // slabs on their way while one is multiplied
static_assert(AHEAD == 1, "through_window");
#define COLUMN 0x7fff
#define TRANSPOSED 0x8000
#else
#define COLUMN -1
#endif

#ifdef ALONE
using Scale = float;
#else
using Scale = real;
#endif

struct BlockRows {
    int begin, own, halo;  // own nodes [begin, begin + own) of the body; nodes read
    const int* nodes;      // (halo,) of the body
    real* values;          // (halo, 3) of the vector that A multiplies
    int* place;            // (halo,) position from which its next values are read; -DCUTS, -DHELPED: and flags
    real *x, *r, *q;       // (own, 3)
#ifdef ERRORS
    real* before;          // (own, 3) x at the last look (iterate_error.cuh)
#endif
    Scale* scale;          // (own, 3) of the inverse, or null
    const int* row_start;  // (own + 1,), less `base`
    const int* columns;    // indices into the halo
    const real* blocks;
    int base;
    bool near;             // the rows of A are in shared memory
    int slabs;             // offset of the SLABS buffers in shared memory, or -1
#ifdef ALONE
    static constexpr int slab_blocks = SLAB_BLOCKS;
    static constexpr bool lent = false;
#else
    int slab_blocks;       // of A, for which each has room
    bool lent;             // they are in memory of the inverse, which needs it between two products
#endif
    int near_values, near_blocks, near_columns;  // offsets in shared memory, if they are there
#ifdef ALONE
    int ring;              // blocks for which the window has room, 0: there is none
    bool whole;            // all blocks are in it
    const int* upper;      // (own + 1,) rank of the first block of each row
    const int* lowest;     // (slabs,) rank of the first block of the window of each slab
#endif

    // Position from which the values of a node of the halo are read.
    __device__ __forceinline__ int position(int node) const {
#if defined(CUTS) && defined(HELPED)
        return place[node] & PLACE & ~RESIDUAL_FAR;
#elif defined(HELPED)
        return place[node] & ~RESIDUAL_FAR;
#elif defined(CUTS)
        return place[node] & PLACE;
#else
        return place[node];
#endif
    }

    // Allocates shared memory, for the most frequently used arrays first. inverted: there is an inverse, which lends the memory `spare` between
    // its applications.
    __device__ __forceinline__ void set_up(const PcgArguments& s, const PcgBody& body, const RowRange& range, Arena& arena, bool inverted, Arena spare) {
        begin = range.begin; own = range.own; halo = range.halo;
        nodes = s.halo + range.halo_first;
        values = arena.take<real>(3 * halo);
        near_values = place_of(values);
        if (!values) values = s.halo_values + 3ll * range.halo_first;
        place = arena.take<int>(halo);
        if (!place) place = s.halo_position + range.halo_first;
        const long long row = body.first + begin, all = 3ll * s.nodes;
#ifdef ERRORS
        constexpr int KEPT = 3;  // entries of a node that are kept beside r, q and x
#else
        constexpr int KEPT = 0;
#endif
        const int others = (inverted ? 12 + KEPT : 9 + KEPT) * own * (int)sizeof(real) + 64;
#ifdef ALONE
        if (!bring_upper(s, (int)row, range, arena, others))
#endif
            bring(s, (int)row, range, arena, spare, others);
        scale = inverted ? arena.take<Scale>(3 * own) : nullptr;
        r = taken(arena, s.own_vectors + 3 * row + all);
        q = taken(arena, s.own_vectors + 3 * row + 2 * all);
#ifdef ALONE  // of all vectors it is used least
        x = whole ? taken(arena, s.own_vectors + 3 * row) : s.own_vectors + 3 * row;
#else
        x = taken(arena, s.own_vectors + 3 * row);
#endif
#ifdef ERRORS
        before = taken(arena, s.own_vectors + 3 * row + 3 * all);
#endif
#ifndef ALONE  // else the nodes are all those of the body
        int* list = arena.take<int>(halo);
        if (!list) return;
        for (int k = threadIdx.x; k < halo; k += THREADS) copy_async(list + k, nodes + k, 4);
        nodes = list;
#endif
        copies_begin();
    }
    __device__ __forceinline__ int node(int k) const {
#ifdef ALONE
        return k;
#else
        return nodes[k];
#endif
    }
    __device__ __forceinline__ real* taken(Arena& arena, real* instead) const {
        real* found = arena.take<real>(3 * own);
        return found ? found : instead;
    }

    // Copies the own rows of A into shared memory if they and `others` bytes fit, since loads after a barrier miss L1.
    // Else they pass through it, if need be through memory that the inverse lends.
    __device__ __forceinline__ void bring(const PcgArguments& s, int row, const RowRange& range, Arena& arena, Arena& spare, int others) {
        [[maybe_unused]] const int count = range.blocks;
        base = range.block_first;
        row_start = s.row_start + row;
        columns = s.local_column + base;
        blocks = s.values + 9ll * base;
        slabs = -1;
        Arena before = arena;
#ifdef ALONE
        near = false;
        int* start;
#else
        lent = false;
        slab_blocks = SLAB_BLOCKS;
        real* v = arena.take<real>(9 * count);
        int *c = arena.take<int>(count), *start = arena.take<int>(own + 1);
        near = v && c && start && near_values >= 0 && arena.end - arena.next >= others;
        near_blocks = place_of(v);
        near_columns = place_of(c);
#endif
        if (!near) {
            arena = before;
            start = arena.take<int>(own + 1);
            if (start && near_values >= 0) slabs = place_of(arena.take<char>(SLABS * slab_bytes()));
#ifndef ALONE
            lent = start && near_values >= 0 && slabs < 0;
            if (lent) {
                slab_blocks = min(SLAB_BLOCKS, (int)((spare.end - spare.next) / SLABS - slab_bytes(0)) / (9 * (int)sizeof(real) + 4) / 4 * 4);
                slabs = slab_blocks > 0 ? place_of(spare.take<char>(SLABS * slab_bytes())) : -1;
            }
#endif
        }
        if (start)
            for (int k = threadIdx.x; k <= own; k += THREADS) copy_async(start + k, row_start + k, 4);
#ifndef ALONE
        if (near) {
            for (int k = threadIdx.x; k < 9 * count; k += THREADS) copy_async(v + k, blocks + k, sizeof(real));
            for (int k = threadIdx.x; k < count; k += THREADS) copy_async(c + k, columns + k, 4);
            blocks = v; columns = c;
        }
#endif
        copies_begin();
        if (slabs >= 0 && !lent)
            for (int k = 0; k < SLABS - 1; ++k) ask(k, row_start);
        if (start) row_start = start;
    }

    // Bytes of a buffer for so many blocks, a multiple of 4: values, then columns, each with what alignment skips.
    static __device__ __forceinline__ int value_bytes(int count) { return count * 9 * (int)sizeof(real) + 16; }
    static __device__ __forceinline__ int slab_bytes(int count) { return value_bytes(count) + 4 * count + 16; }
    __device__ __forceinline__ int slab_bytes() const { return slab_bytes(slab_blocks); }

    struct Slab { int low, high, first, count; };  // rows, and their range in `blocks`

    template <int ROWS = SLAB>
    __device__ __forceinline__ Slab slab(int k, const int* starts) const {
        const int low = min(k * ROWS, own), high = min(low + ROWS, own);
        return {low, high, starts[low] - base, starts[high] - starts[low]};
    }

    // Begins to copy a slab into its buffer, aligned to 16 bytes.
    __device__ __forceinline__ void ask(int k, const int* starts) const {
        const Slab s = slab(k, starts);
        char* to = shared_memory + slabs + k % SLABS * slab_bytes();
        if (s.count <= slab_blocks && s.count > 0) {
            all_of(to, blocks + 9ll * s.first, 9 * (int)sizeof(real) * s.count);
            all_of(to + value_bytes(slab_blocks), columns + s.first, 4 * s.count);
        }
        copies_begin();
    }
    static __device__ __forceinline__ void all_of(char* to, const void* from, int bytes) {
        const int skipped = (int)((unsigned long long)from & 15);
        const char* begin = (const char*)from - skipped;
        for (int k = 16 * threadIdx.x; k < skipped + bytes; k += 16 * THREADS) copy_async(to + k, begin + k, 16);
    }

#ifdef ALONE
    static constexpr int WORD_BYTES = 4 * WINDOW_BLOCKS + 16;

    // Allocates the window, and begins to fill it. Returns false if it does not fit.
    __device__ __forceinline__ bool bring_upper(const PcgArguments& s, int row, const RowRange& range, Arena& arena, int others) {
        const int *ranks = s.upper_start + row + range.body, count = (own + WINDOW_ROWS - 1) / WINDOW_ROWS;
        Arena before = arena;
        ring = 0;
        whole = false;
        int *starts = arena.take<int>(own + 1), *uppers = arena.take<int>(own + 1), *firsts = arena.take<int>(count);
        const Arena rest = arena;
        real* v = arena.take<real>(9 * range.upper);
        int* c = arena.take<int>(range.blocks);
        whole = v && c && arena.end - arena.next >= others;
        if (!whole) {
            arena = rest;
            v = arena.take<real>(9 * range.window);
            c = (int*)arena.take<char>((AHEAD + 1) * WORD_BYTES);
        }
        if (!starts || !uppers || !firsts || !v || !c || near_values < 0 || range.window == 0) {
            arena = before;
            whole = false;
            return false;
        }
        base = range.block_first;
        row_start = s.row_start + row;
        columns = s.local_column + base;
        blocks = s.values + 9ll * base;
        near_blocks = place_of(v);
        near_columns = place_of(c);
        ring = whole ? range.upper : range.window;
        for (int k = threadIdx.x; k <= own; k += THREADS) {
            copy_async(starts + k, row_start + k, 4);
            copy_async(uppers + k, ranks + k, 4);
        }
        for (int k = threadIdx.x; k < count; k += THREADS) firsts[k] = ranks[s.lowest_row[row + k * WINDOW_ROWS]];
        if (whole)
            for (int k = threadIdx.x; k < range.blocks; k += THREADS) copy_async(c + k, columns + k, 4);
        copies_begin();
        row_start = starts; upper = uppers; lowest = firsts;
        copies_end<0>();
        __syncthreads();
        if (whole) {
            ask_rows(0, own, 0, 0);
            copies_begin();
        } else {
            ask_upper(0, slab<WINDOW_ROWS>(0, row_start), 0, 0);
        }
        return true;
    }

    // Place in the window of a block, by its rank, where the block of rank `first` is at `at`.
    __device__ __forceinline__ int placed(int rank, int first, int at) const {
        const int place = rank - first + at;
        return place < ring ? place : place - ring;
    }

    // Begins to copy the blocks of rows from the diagonal on, half a warp two of them, whose sizes are loaded together.
    __device__ __forceinline__ void ask_rows(int low, int high, int first, int at) const {
        constexpr int STEP = THREADS / 16;
        const int lane = threadIdx.x % 16;
        real* window = (real*)(shared_memory + near_blocks);
        for (int begin = low + (int)threadIdx.x / 16; begin < high; begin += 2 * STEP) {
            int place[2], count[2];
            const real* from[2];
#pragma unroll
            for (int n = 0; n < 2; ++n) {
                const int row = min(begin + n * STEP, high - 1), rank = upper[row];
                count[n] = begin + n * STEP < high ? 9 * (upper[row + 1] - rank) : 0;
                place[n] = placed(rank, first, at);
                from[n] = blocks + 9ll * (row_start[row + 1] - base) - count[n];
            }
#pragma unroll
            for (int n = 0; n < 2; ++n) {
                const int room = 9 * (ring - place[n]);
                for (int k = lane; k < count[n]; k += 16) copy_async(window + 9 * place[n] + (k < room ? k : k - 9 * ring), from[n] + k, sizeof(real));
            }
        }
    }

    // Begins to copy the k-th slab into the window, and its words.
    __device__ __forceinline__ void ask_upper(int k, const Slab& s, int first, int at) const {
        if (s.low < s.high) {
            ask_rows(s.low, s.high, first, at);
            all_of(shared_memory + near_columns + k % (AHEAD + 1) * WORD_BYTES, columns + s.first, 4 * s.count);
        }
        copies_begin();
    }

    // The window moves down A. Its first slab for the next product is copied after this one, beside other work. Where the next slabs are is
    // looked up before the barrier.
    template <class Done>
    __device__ __forceinline__ void through_window(Done done) const {
        const int count = (own + WINDOW_ROWS - 1) / WINDOW_ROWS;
        Slab s = slab<WINDOW_ROWS>(0, row_start), next = slab<WINDOW_ROWS>(1, row_start);
        int first = 0, at = 0;
        for (int k = 0; k < count; ++k) {
            int origin = base, c = near_columns;
            if (!whole) {
                copies_end<AHEAD - 1>();
                __syncthreads();  // this slab is complete, and the one before is not read any more
                ask_upper(k + AHEAD, next, first, at);
                origin += s.first;
                c += k % (AHEAD + 1) * WORD_BYTES + (int)((unsigned long long)(columns + s.first) & 15);
            }
            of_window(s.low + WARP_ROWS * (int)(threadIdx.x / 32), s.high, origin, c, first, at, done);
            s = next;
            next = slab<WINDOW_ROWS>(k + 1 + AHEAD, row_start);
            if (!whole && k + 1 < count) {
                const int then = first;
                first = lowest[k + 1];
                at += first - then;
                at -= at < ring ? 0 : ring;
            }
        }
        if (whole) return;
        __syncthreads();
        ask_upper(0, slab<WINDOW_ROWS>(0, row_start), 0, 0);
    }

    // Rows low, low + 1, ... of a warp: lane ROW_LANES n + h adds blocks h, h + ROW_LANES, ... of the n-th. c_at: offset of the words
    // from the block on that is `origin`-th. first, at: of the window (placed).
    template <class Done>
    __device__ __forceinline__ void of_window(int low, int end, int origin, int c_at, int first, int at, Done done) const {
        const real *a_of = shared_at<real>(near_blocks), *v_of = shared_at<real>(near_values);
        const int* c_of = shared_at<int>(c_at);
        const int lane = threadIdx.x % 32, h = lane % ROW_LANES, node = low + lane / ROW_LANES, size = ring;
        int k = 0, last = 0;
        if (node < end) {
            k = row_start[node] - origin + h;
            last = row_start[node + 1] - origin;
        }
        real sum[3] = {0, 0, 0};
#pragma unroll 2
        for (; k < last; k += ROW_LANES) {
            const unsigned word = c_of[k];
            const bool transposed = word & TRANSPOSED;
            int place = (int)(word >> 16) - first + at;
            place -= place < size ? 0 : size;
            const int row = transposed ? 1 : 3, column = transposed ? 3 : 1;
            const real *a = a_of + 9 * place, *v = v_of + 3 * (word & COLUMN), v0 = v[0], v1 = v[1], v2 = v[2];
            sum[0] += a[0] * v0 + a[column] * v1 + a[2 * column] * v2;
            sum[1] += a[row] * v0 + a[4] * v1 + a[row + 2 * column] * v2;
            sum[2] += a[2 * row] * v0 + a[2 * row + column] * v1 + a[8] * v2;
        }
        // Of the lanes of a row the half with the larger h adds up entry 2, and of the others half each entries 0 and 1.
        const bool third = h & ROW_LANES / 2, second = h & ROW_LANES / 4;
        const real given = __shfl_xor_sync(ALL, third ? sum[0] : sum[2], ROW_LANES / 2), middle = __shfl_xor_sync(ALL, sum[1], ROW_LANES / 2);
        const real one = (third ? sum[2] : sum[0]) + given, two = third ? one : sum[1] + middle;
        real mine = (second ? two : one) + __shfl_xor_sync(ALL, second ? one : two, ROW_LANES / 4);
#pragma unroll
        for (int by = ROW_LANES / 8; by > 0; by /= 2) mine += __shfl_xor_sync(ALL, mine, by);
        if (node < end && h % (ROW_LANES / 4) == 0 && h < 3 * ROW_LANES / 4) done(node, h / (ROW_LANES / 4), mine);
    }
#endif

    // Keeps entry k of q = A p, p being `values`, and adds what it is to the sums p.q, r.q, q.q and r.r.
    __device__ __forceinline__ void keep_product(int k, real product, double (&sums)[4]) const {
        const double p = values[k], residual = r[k], qk = product;
        sums[0] += p * qk;
        sums[1] += residual * qk;
        sums[2] += qk * qk;
        sums[3] += residual * residual;
        q[k] = product;
    }

    // q = A values for the own nodes. done(node, c, q): entry c of a node's, called by as many lanes as there are.
    template <class Done>
    __device__ __forceinline__ void multiply(Done done) const {
#ifdef ALONE
        if (ring > 0) through_window(done);
        else if (slabs >= 0) through_slabs(done);
        else some_rows<TOGETHER, false>(done);
#else
        if (slabs >= 0) through_slabs(done);
        else if (!near) some_rows<TOGETHER, false>(done);
        else if (own <= WARPS) some_rows<1, true>(done);
        else some_rows<TOGETHER, true>(done);
#endif
    }

    template <int N, bool NEAR, class Done>
    __device__ __forceinline__ void some_rows(Done done) const {
        for (int first = threadIdx.x / 32; first < own; first += N * WARPS) {
            real sum[N];
            if (NEAR) of_near<N>(first, own, base, near_blocks, near_columns, sum);
            else of_far<N>(first, own, sum);
            finish<N>(first, own, sum, done);
        }
    }

    // The rows pass through shared memory in slabs. The first slabs of the next product are copied after this one, beside other
    // work, unless the memory is lent; the number of slabs is a multiple of SLABS, so that each slab has its buffer.
    template <class Done>
    __device__ __forceinline__ void through_slabs(Done done) const {
        const int count = (own + SLABS * SLAB - 1) / (SLABS * SLAB) * SLABS;
        for (int k = lent ? 1 - SLABS : 0; k < count; ++k) {  // one place that asks: its code is long
            if (k >= 0) {
                copies_end<SLABS - 2>();
                __syncthreads();  // this slab is complete, and the one before is not read any more
            }
            const int next = k + SLABS - 1;
            if (next < count || !lent) ask(next < count ? next : next - count, row_start);
            if (k < 0) continue;
            const Slab s = slab(k, row_start);
            const int first = s.low + (int)threadIdx.x / 32;
            if (first >= s.high) continue;
            if (s.count > slab_blocks) {
                for (int row = first; row < s.high; row += TOGETHER * WARPS) {
                    real sum[TOGETHER];
                    of_far<TOGETHER>(row, s.high, sum);
                    finish<TOGETHER>(row, s.high, sum, done);
                }
                continue;
            }
            const int here = slabs + k % SLABS * slab_bytes();
            const int a = here + (int)((unsigned long long)(blocks + 9ll * s.first) & 15);
            const int c = here + value_bytes(slab_blocks) + (int)((unsigned long long)(columns + s.first) & 15);
            real sum[SLAB_ROWS];
            of_near<SLAB_ROWS>(first, s.high, base + s.first, a, c, sum);
            finish<SLAB_ROWS>(first, s.high, sum, done);
        }
    }

    // Passes the sums of rows first, first + WARPS, ... to `done`: lane 3 n + c has entry c of the n-th row.
    template <int N, class Done>
    static __device__ __forceinline__ void finish(int first, int end, const real sum[N], Done done) {
        const int lane = threadIdx.x % 32, n = lane / 3, c = lane - 3 * n;
        real mine = sum[0];
        if (N > 1) {
            mine = __shfl_sync(ALL, sum[0], c);
#pragma unroll
            for (int k = 1; k < N; ++k) {
                const real other = __shfl_sync(ALL, sum[k], c);
                mine = n == k ? other : mine;
            }
        }
        if (lane < 3 * N && first + n * WARPS < end) done(first + n * WARPS, c, mine);
    }

    // Eight blocks of a row at a time: lane 3 e + r has row r of block e. The sums end in lanes 0, 1, 2. Rows of up to 16 blocks
    // go without a branch, so that the warp's rows overlap. a_at, c_at: offsets of values and columns from the
    // block on that is `origin`-th.
    template <int N>
    __device__ __forceinline__ void of_near(int first, int end, int origin, int a_at, int c_at, real sum[N]) const {
        const real *a_of = shared_at<real>(a_at), *v_of = shared_at<real>(near_values);
        const int* c_of = shared_at<int>(c_at);
        const int lane = threadIdx.x % 32, entry = lane / 3, r = lane - 3 * entry;
#pragma unroll
        for (int n = 0; n < N; ++n) {
            const int node = min(first + n * WARPS, end - 1), low = row_start[node] - origin, high = row_start[node + 1] - origin;
            sum[n] = 0;
#pragma unroll
            for (int e = 0; e < 16; e += 8) {
                const int k = low + e + entry, there = min(k, high - 1);
                const real *a = a_of + 9 * there + 3 * r, *v = v_of + 3 * (c_of[there] & COLUMN);
                const real product = a[0] * v[0] + a[1] * v[1] + a[2] * v[2];
                sum[n] += lane < 24 && k < high ? product : 0;
            }
            for (int k = low + 16 + entry; k < high && lane < 24; k += 8) {
                const real *a = a_of + 9 * k + 3 * r, *v = v_of + 3 * (c_of[k] & COLUMN);
                sum[n] += a[0] * v[0] + a[1] * v[1] + a[2] * v[2];
            }
        }
        for (int k = 12; k >= 3; k >>= 1)
#pragma unroll
            for (int n = 0; n < N; ++n) sum[n] += __shfl_down_sync(ALL, sum[n], k);
    }

    // Three at a time: lane 9 e + 3 r + c has entry (r, c) of block e, so that A is read in order.
    template <int N>
    __device__ __forceinline__ void of_far(int first, int end, real sum[N]) const {
        const int lane = threadIdx.x % 32, entry = lane / 9, c = lane % 3;
#pragma unroll
        for (int n = 0; n < N; ++n) {
            const int node = min(first + n * WARPS, end - 1), low = row_start[node] - base, high = row_start[node + 1] - base;
            sum[n] = 0;
#pragma unroll
            for (int e = 0; e < 15; e += 3) {
                const int k = low + e + entry, there = min(k, high - 1);
                const real product = blocks[9ll * there + lane % 9] * values[3 * (__ldg(columns + there) & COLUMN) + c];
                sum[n] += lane < 27 && k < high ? product : 0;
            }
            for (int k = low + 15 + entry; k < high && lane < 27; k += 3)
                sum[n] += blocks[9ll * k + lane % 9] * values[3 * (__ldg(columns + k) & COLUMN) + c];
        }
#pragma unroll
        for (int n = 0; n < N; ++n) {
            sum[n] += __shfl_down_sync(ALL, sum[n], 9) + __shfl_down_sync(ALL, sum[n], 18);  // lanes 0 to 8: entry (r, c)
            sum[n] += __shfl_down_sync(ALL, sum[n], 1) + __shfl_down_sync(ALL, sum[n], 2);   // lanes 0, 3, 6: row r
            sum[n] = __shfl_sync(ALL, sum[n], lane < 3 ? 3 * lane : 0);
        }
    }

    // values = (values of exchange `number`) + beta values, for all nodes of the halo.
    // changed(k, value): what becomes of a value of the exchange, by entry of the halo.
    template <class T, class Changed>
    __device__ __forceinline__ void form(const FlagWord<T>* from, unsigned number, real beta, Changed changed) const {
        for (int first = threadIdx.x; first < 3 * halo; first += 3 * THREADS) {
            FlagWord<T> seen[3];
            T got[3];
            int at[3];
            bool all;
#pragma unroll
            for (int n = 0; n < 3; ++n) {
                const int k = min(first + n * THREADS, 3 * halo - 1);
                at[n] = position(k / 3) + k % 3;
            }
            unsigned spins = 0;
            do {  // no branch between the loads: they travel together
#pragma unroll
                for (int n = 0; n < 3; ++n) seen[n] = from[at[n]].load();
                all = true;
#pragma unroll
                for (int n = 0; n < 3; ++n) all &= seen[n].unpack(got[n], number);
            } while (keep_polling(!all, spins));
#pragma unroll
            for (int n = 0; n < 3; ++n) {
                const int k = first + n * THREADS;
                if (k < 3 * halo) got[n] = changed(k, got[n]);
#ifdef ERRORS
                if (k < 3 * own) q[k] = got[n];  // A p is formed next
#endif
                if (k < 3 * halo) values[k] = beta != 0 ? got[n] + beta * values[k] : got[n];
            }
        }
        __syncthreads();
    }
};
