// SPDX-License-Identifier: MIT
// Builds the matrices of a plan (plan.py) from the values of L, all parts of a batch at once. GPU only. Factors of one plan that are
// there together are built in the same launches: each has matrices G and T of its own, and the tasks of one follow those of another.
//
// A part with v degrees of freedom inside and b in its boundary, both padded to 64, has a matrix G of v rows and v + b columns,
// at first [L_VV^T | L_BV^T], in the order of L's columns. The diagonal blocks of 64 are inverted in place. Then neighbouring
// blocks are merged, 64 -> 128 -> ..: the inverse of [L1 0; C L2] is [Y1 0; X Y2] with X = -Y2 (C Y1). X is written below the
// diagonal; C = L21 is above it, transposed; C Y1 is in a matrix T. At the end G holds Y = L_VV^-1 on and below its diagonal
// blocks, and the result is [Y^T Y | Y^T L_BV^T] in tiles of 64 x 64.
//
// A group of threads takes tasks one after another from a list; a thread block may have any number of groups. Few large blocks
// keep few multiprocessors busy; many small ones end soon and leave room for more urgent work. All is float32, and every sum has
// a fixed order, so results do not depend on the number of blocks or groups.
constexpr int EDGE = 64;  // rows and columns of a tile
constexpr int MOST_BUILDS = 64;  // inverses that are built in the same launches
#define DEPTH 8          // rows of G that are in shared memory at a time
#define THREADS 128      // of a group
#define PITCH 65         // of a finished tile in shared memory
#define SHARED (EDGE * PITCH + 2 * EDGE)   // floats of a group
#define LENGTHS 256      // threads of a group that sums columns
#define KERNEL_OF(threads) extern "C" __global__ void __launch_bounds__(threads)

extern __shared__ float4 dynamic[];   // of all groups

struct Part {
    long long g, t;                    // first entries of G and T in the workspace
    int v, b;                          // degrees of freedom
    int pitch_g, pitch_t;              // entries per row
    int start, boundary, out, unused;  // as in plan.Parts
};

struct Column {                      // of L
    long long value, row;              // index of its first value, and of that value's row in the row lists
    int length, part, within, unused;  // within: index in the part
};

struct TileTask { int part, i, j, end; }; // tile in units of 64; end: of the first of two merged runs

struct InverseStorage {
    unsigned short* matrix;  // (chunks, 8, 32)
    float* scale;            // (N + 1,)
};

struct Builds {              // set before each launch of the graph
    int count, unused[3];    // inverses that are built
    InverseStorage targets[MOST_BUILDS];
};

struct Strides {             // from one inverse to the next [entries]
    long long value, g, t;   // values of L, G, T
    long long first_t;       // of T of the first one, beyond part.t
};

__device__ __forceinline__ float* g_of(float* workspace, const Strides& s, const Part& part, int copy) {
    return workspace + s.g * copy + part.g;
}
__device__ __forceinline__ float* t_of(float* workspace, const Strides& s, const Part& part, int copy) {
    return workspace + s.first_t + s.t * copy + part.t;
}

// Threads of a block that do a task together. first, step: of the tasks that they take.
template <int SIZE>
struct ThreadGroup {
    int thread, index, first, step;
    __device__ __forceinline__ ThreadGroup()
        : thread(threadIdx.x % SIZE), index(threadIdx.x / SIZE), first(blockIdx.x * (blockDim.x / SIZE) + index),
          step(gridDim.x * (blockDim.x / SIZE)) {}
    __device__ __forceinline__ void barrier() const { asm volatile("bar.sync %0, %1;" ::"r"(index + 1), "n"(SIZE) : "memory"); }
};

__device__ __forceinline__ int padded(int n, int step) { return (n + step - 1) / step * step; }

// Values into G, a warp per column. place: column in its part's G of each entry of L's row lists. begin: the first batch.
KERNEL_OF(1024) scatter(const Part* parts, const Column* columns, int count, const int* place, const float* values,
                           float* workspace, Strides strides, int begin, int scale_end, const Builds* builds) {
    const int copies = builds->count;
    if (begin && blockIdx.x == 0)
        for (int k = threadIdx.x; k < copies; k += blockDim.x) builds->targets[k].scale[scale_end] = 0;
    ThreadGroup<32> warp;
    for (int c = warp.first; c < copies * count; c += warp.step) {
        const int copy = c / count;
        const Column column = columns[c % count];
        const Part part = parts[column.part];
        float* row = g_of(workspace, strides, part, copy) + (long long)column.within * part.pitch_g;
        const float* value = values + strides.value * copy + column.value;
        const int* to = place + column.row;
#pragma unroll 4
        for (int k = warp.thread; k < column.length; k += 32) row[to[k]] = value[k];
    }
}

// Diagonal blocks: L^T in, L^-1 out. A thread has a column of the inverse in registers.
KERNEL_OF(4 * EDGE) invert(const Part* parts, const TileTask* tasks, int count, float* workspace, Strides strides, const Builds* builds) {
    ThreadGroup<EDGE> group;
    int j = group.thread;
    float(*rows)[EDGE] = (float(*)[EDGE])((float*)dynamic + group.index * EDGE * (EDGE + 1));   // of L^T
    float* pivots = rows[EDGE];
    const int copies = builds->count;
    for (int t = group.first; t < copies * count; t += group.step) {
        const TileTask task = tasks[t % count];
        const Part part = parts[task.part];
        float* block = g_of(workspace, strides, part, t / count) + (long long)task.i * EDGE * part.pitch_g + task.i * EDGE + j;
        int inside = part.v - task.i * EDGE;
        for (int i = 0; i < EDGE; i++) rows[i][j] = block[(long long)i * part.pitch_g];
        group.barrier();
        pivots[j] = j < inside ? 1 / rows[j][j] : 0;
        group.barrier();
        float x[EDGE];
#pragma unroll
        for (int i = 0; i < EDGE; i++) x[i] = i == j ? 1.f : 0.f;
#pragma unroll
        for (int i = 0; i < EDGE; i++) {
            x[i] *= pivots[i];
#pragma unroll
            for (int k = i / 4 * 4; k < EDGE; k += 4) {
                float4 u = *(float4*)&rows[i][k];
                if (k > i) x[k] -= u.x * x[i];
                if (k + 1 > i) x[k + 1] -= u.y * x[i];
                if (k + 2 > i) x[k + 2] -= u.z * x[i];
                if (k + 3 > i) x[k + 3] -= u.w * x[i];
            }
        }
#pragma unroll
        for (int i = 0; i < EDGE; i++) block[(long long)i * part.pitch_g] = x[i];
        group.barrier();
    }
}

struct Operand { const float* from; int pitch; };

// Product A^T B of A, B (depth, 64), row-major, in tiles of 64 x 64 (ACROSS: A B with A (64, depth)). A thread has 8 x 4
// entries: with fewer a multiprocessor waits for shared memory, with more a tile takes too long.
template <bool ACROSS>
struct Product {
    const ThreadGroup<THREADS>& group;
    float (*const a)[DEPTH][EDGE];
    float (*const b)[DEPTH][EDGE];
    float sum[8][4];
    int row, column;  // of this thread's entries in the tile: rows row .. row + 3 and row + 32 .. row + 35

    __device__ __forceinline__ Product(const ThreadGroup<THREADS>& g, float* shared)
        : group(g), a((float(*)[DEPTH][EDGE])shared), b(a + 2) {
        int lane = g.thread % 32, warp = g.thread / 32;
        row = warp / 2 * 16 + lane / 8 * 4;
        column = warp % 2 * 32 + lane % 8 * 4;
    }

    __device__ __forceinline__ float4 fetch(Operand o, int k) const {
        return *(const float4*)(o.from + (long long)(k + group.thread / 16) * o.pitch + group.thread % 16 * 4);
    }
    __device__ __forceinline__ void put(float (*to)[EDGE], float4 x) const {
        *(float4*)&to[group.thread / 16][group.thread % 16 * 4] = x;
    }
    __device__ __forceinline__ float4 fetch_a(Operand o, int k) const {
        if constexpr (!ACROSS) return fetch(o, k);
        else return *(const float4*)(o.from + (long long)(group.thread / 2) * o.pitch + k + group.thread % 2 * 4);
    }
    __device__ __forceinline__ void put_a(float (*to)[EDGE], float4 x) const {
        if constexpr (!ACROSS) return put(to, x);
        int k = group.thread % 2 * 4, i = group.thread / 2;
        to[k][i] = x.x; to[k + 1][i] = x.y; to[k + 2][i] = x.z; to[k + 3][i] = x.w;
    }
    __device__ __forceinline__ void multiply(int buffer) {
#pragma unroll
        for (int k = 0; k < DEPTH; k++) {
            float p[8], q[4];
            *(float4*)p = *(float4*)&a[buffer][k][row];
            *(float4*)(p + 4) = *(float4*)&a[buffer][k][row + 32];
            *(float4*)q = *(float4*)&b[buffer][k][column];
#pragma unroll
            for (int i = 0; i < 8; i++)
#pragma unroll
                for (int j = 0; j < 4; j++) sum[i][j] += p[i] * q[j];
        }
    }

    // depth: a multiple of 64. The next slice is loaded while one is multiplied.
    __device__ __forceinline__ void run(Operand oa, Operand ob, int depth) {
#pragma unroll
        for (int i = 0; i < 8; i++)
#pragma unroll
            for (int j = 0; j < 4; j++) sum[i][j] = 0;
        float4 x = fetch_a(oa, 0), y = fetch(ob, 0);
        group.barrier();
        put_a(a[0], x);
        put(b[0], y);
        group.barrier();
        for (int k = 0; k < depth; k += DEPTH) {
            int buffer = k / DEPTH % 2;
            bool more = k + DEPTH < depth;
            if (more) {
                x = fetch_a(oa, k + DEPTH);
                y = fetch(ob, k + DEPTH);
            }
            multiply(buffer);
            if (more) {
                put_a(a[1 - buffer], x);
                put(b[1 - buffer], y);
            }
            group.barrier();
        }
    }

    // Row of the i-th of this thread's rows.
    __device__ __forceinline__ int row_of(int i) const { return row + i % 4 + i / 4 * 32; }

    __device__ __forceinline__ void store(float* to, int pitch, float sign) const {
#pragma unroll
        for (int i = 0; i < 8; i++)
            *(float4*)(to + (long long)row_of(i) * pitch + column) =
                make_float4(sign * sum[i][0], sign * sum[i][1], sign * sum[i][2], sign * sum[i][3]);
    }
};

// T = C Y1: tile (i, j) of a pair of runs j .. end, end .. i ..
KERNEL_OF(5 * THREADS) couple(const Part* parts, const TileTask* tasks, int count, float* workspace, Strides strides, const Builds* builds) {
    ThreadGroup<THREADS> group;
    float* shared = (float*)dynamic + group.index * SHARED;
    const int copies = builds->count;
    for (int t = group.first; t < copies * count; t += group.step) {
        const TileTask task = tasks[t % count];
        const Part part = parts[task.part];
        const float* rows = g_of(workspace, strides, part, t / count) + (long long)task.j * EDGE * part.pitch_g;
        Product<false> product(group, shared);
        product.run({rows + task.i * EDGE, part.pitch_g}, {rows + task.j * EDGE, part.pitch_g}, (task.end - task.j) * EDGE);
        product.store(t_of(workspace, strides, part, t / count) + (long long)task.i * EDGE * part.pitch_t + task.j * EDGE, part.pitch_t, 1);
    }
}

// X = -Y2 T.
KERNEL_OF(5 * THREADS) merge(const Part* parts, const TileTask* tasks, int count, float* workspace, Strides strides, const Builds* builds) {
    ThreadGroup<THREADS> group;
    float* shared = (float*)dynamic + group.index * SHARED;
    const int copies = builds->count;
    for (int t = group.first; t < copies * count; t += group.step) {
        const TileTask task = tasks[t % count];
        const Part part = parts[task.part];
        float* row = g_of(workspace, strides, part, t / count) + (long long)task.i * EDGE * part.pitch_g;
        const float* coupled = t_of(workspace, strides, part, t / count) + (long long)task.end * EDGE * part.pitch_t + task.j * EDGE;
        Product<true> product(group, shared);
        product.run({row + task.end * EDGE, part.pitch_g}, {coupled, part.pitch_t}, (task.i + 1 - task.end) * EDGE);
        product.store(row + task.j * EDGE, part.pitch_g, -1);
    }
}

// Scale: length of the columns of Y, 32 columns of a block of 64 at a time; the largest one goes to scale[scale_end].
KERNEL_OF(4 * LENGTHS) lengths(const Part* parts, const TileTask* tasks, int count, float* workspace, Strides strides,
                             const Builds* builds, int scale_end) {
    ThreadGroup<LENGTHS> group;
    float(*sums)[32] = (float(*)[32])((float*)dynamic + group.index * LENGTHS);
    const int copies = builds->count;
    int lane = group.thread % 32, warp = group.thread / 32;
    for (int t = group.first; t < 2 * copies * count; t += group.step) {
        const int copy = t / 2 / count;
        const TileTask task = tasks[t / 2 % count];
        const Part part = parts[task.part];
        const float* g = g_of(workspace, strides, part, copy);
        float* scale = builds->targets[copy].scale;
        int j = task.i * EDGE + t % 2 * 32 + lane;
        float sum = 0;
#pragma unroll 4
        for (int k = task.i * EDGE + warp; k < part.v; k += LENGTHS / 32) {
            float y = g[(long long)k * part.pitch_g + j];
            sum += y * y;
        }
        sums[warp][lane] = sum;
        group.barrier();
        if (warp == 0 && j < part.v) {
            for (int k = 1; k < LENGTHS / 32; k++) sum += sums[k][lane];
            sum = sqrtf(sum);
            scale[part.start + j] = sum;
            atomicMax((int*)(scale + scale_end), __float_as_int(sum));   // positive numbers are ordered as their bits are
        }
        group.barrier();
    }
}

// Packs two float16 numbers; the largest finite one instead of infinity.
__device__ __forceinline__ unsigned halves(float lo, float hi) {
    unsigned word;
    lo = lo > 65504.f ? 65504.f : lo < -65504.f ? -65504.f : lo;
    hi = hi > 65504.f ? 65504.f : hi < -65504.f ? -65504.f : hi;
    asm("{.reg .b16 a, b; cvt.rn.f16.f32 a, %1; cvt.rn.f16.f32 b, %2; mov.b32 %0, {a, b};}" : "=r"(word) : "f"(lo), "f"(hi));
    return word;
}

__device__ __forceinline__ float number(unsigned word, int upper) {
    float x;
    unsigned short h = upper ? word >> 16 : word & 0xffff;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(h));
    return x;
}

// A tile of 64 x 64 (rows of `tile`, or its columns if ACROSS) as chunks. chunk_of: first chunk of 8 rows, from the tile's
// first row on; rows, columns: how many there are from there on, padded; column: the tile's first in the matrix; width: of
// the whole matrix in chunks.
template <bool ACROSS>
__device__ __forceinline__ void store(int thread, float (*tile)[PITCH], float sign, const int* chunk_of, int rows, int columns,
                                      int column, int width, int planes, unsigned short* matrix) {
    for (int k = thread; k < EDGE * EDGE / 8; k += THREADS) {
        int piece = k % 4, row = k / 4 % 8, chunk = k / 32;
        int r = chunk / 2 * 8 + row, c = chunk % 2 * 32 + piece * 8;
        if (r >= rows || c >= columns) continue;
        float x[8];
#pragma unroll
        for (int e = 0; e < 8; e++) x[e] = sign * (ACROSS ? tile[c + e][r] : tile[r][c + e]);
        unsigned w[4];
#pragma unroll
        for (int e = 0; e < 4; e++) w[e] = halves(x[2 * e], x[2 * e + 1]);
        long long at = chunk_of[r / 8] + (column + c) / 32;
        uint4* to = (uint4*)(matrix + at * 256) + row * 4 + piece;
        *to = make_uint4(w[0], w[1], w[2], w[3]);
        if (planes == 1) continue;
#pragma unroll
        for (int e = 0; e < 8; e++) x[e] = (x[e] - number(w[e / 2], e % 2)) * 2048.f;
        to[(long long)width * 32] = make_uint4(halves(x[0], x[1]), halves(x[2], x[3]), halves(x[4], x[5]), halves(x[6], x[7]));
    }
}

// Tile (i, j) of [Y^T Y | Y^T L_BV^T] into the storage: twice, since the inverse is symmetric and the coupling is applied
// both ways. row_chunk (N / 8,), out_chunk (contributions / 8,): first chunk of each 8 rows.
KERNEL_OF(5 * THREADS) finish(const Part* parts, const TileTask* tasks, int count, float* workspace, Strides strides,
                            const Builds* builds, const int* boundary, const int* row_chunk, const int* out_chunk, int planes) {
    ThreadGroup<THREADS> group;
    float* shared = (float*)dynamic + group.index * SHARED;
    float(*tile)[PITCH] = (float(*)[PITCH])shared;   // after the product
    float *down = shared + SHARED - 2 * EDGE, *across = down + EDGE;
    const int copies = builds->count;
    for (int t = group.first; t < copies * count; t += group.step) {
        const TileTask task = tasks[t % count];
        const Part part = parts[task.part];
        const InverseStorage to = builds->targets[t / count];
        int i = task.i * EDGE, j = task.j * EDGE, inside = padded(part.v, EDGE), edge = j - inside;
        const float* rows = g_of(workspace, strides, part, t / count) + (long long)i * part.pitch_g;
        Product<false> product(group, shared);
        product.run({rows + i, part.pitch_g}, {rows + j, part.pitch_g}, inside - i);
        for (int k = group.thread; k < EDGE; k += THREADS) {
            down[k] = i + k < part.v ? 1 / to.scale[part.start + i + k] : 0;
            float d = 0;
            if (edge >= 0) { if (edge + k < part.b) d = to.scale[boundary[part.boundary + edge + k]]; }
            else if (j + k < part.v) d = 1 / to.scale[part.start + j + k];
            across[k] = d;
        }
        group.barrier();
#pragma unroll
        for (int r = 0; r < 8; r++)
#pragma unroll
            for (int c = 0; c < 4; c++) {
                int row = product.row_of(r), column = product.column + c;
                tile[row][column] = product.sum[r][c] * (down[row] * across[column]);
            }
        group.barrier();
        int rows_v = padded(part.v, 8), columns_v = padded(part.v, 32), width = (columns_v + padded(part.b, 32)) / 32;
        const int* own = row_chunk + part.start / 8;
        if (edge < 0) {
            store<false>(group.thread, tile, 1, own + i / 8, rows_v - i, columns_v - j, j, width, planes, to.matrix);
            if (i != j) store<true>(group.thread, tile, 1, own + j / 8, rows_v - j, columns_v - i, i, width, planes, to.matrix);
        } else {
            store<false>(group.thread, tile, -1, own + i / 8, rows_v - i, padded(part.b, 32) - edge, columns_v + edge, width, planes, to.matrix);
            store<true>(group.thread, tile, 1, out_chunk + (part.out + edge) / 8, padded(part.b, 8) - edge, columns_v - i, i,
                        columns_v / 32, planes, to.matrix);
        }
    }
}
