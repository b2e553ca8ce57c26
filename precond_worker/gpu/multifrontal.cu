// SPDX-License-Identifier: MIT
// Multifrontal Cholesky factorization of many fronts at a time (plan.py defines fronts, executor.py launches).
//
// All fronts of a level are eliminated together, WIDTH columns a step, in two launches: `panel` divides the rows under
// the diagonal block by it, `update` subtracts the products of those rows from the rest, in tiles of 64 x 64, and goes
// on to factorize the next diagonal block. Every entry is written by one thread and sums run in a fixed order, so
// the same matrix gives the same bits.
//
// real: of the arithmetic and the fronts; Value: of the values of L.
// The strict upper triangle of a diagonal block holds the transposed inverse of its factor.
#ifndef Value
#define Value float
#endif

typedef long long Long;
const int WIDTH = 64, CHUNK = 2, THREADS = 128;
const int DEEP = 32;      // columns of two operands that are in shared memory at a time
const int PITCH = 64 + 4;  // reals from one such column to the next: a warp's reads fall on different banks

#define LANE (int(threadIdx.x) % 32)
#define WARP (int(threadIdx.x) / 32)

struct Front {
    Long at, value, child, map, split;  // see MultifrontalPlan
    int own, rows, stride, column;
    int children, unused;
};

struct FactorStatus {
    int pivot;     // first column of L whose pivot was not positive
    int range;     // first column with a value outside the range of Value
    int infinite;  // a value of A is NaN or infinite
};

extern "C" __global__ void reset(FactorStatus* status) { *status = FactorStatus{0x7fffffff, 0x7fffffff, 0}; }

template <class T> __device__ bool finite(T v) { return v - v == 0; }

extern "C" __global__ void check_finite(const double* blocks, Long count, FactorStatus* status) {
    for (Long i = blockIdx.x * (Long)blockDim.x + threadIdx.x; i < count; i += (Long)gridDim.x * blockDim.x)
        if (!finite(blocks[i])) status->infinite = 1;
}

// Returns the i with start[i] <= block < start[i + 1]; all threads of the block search together.
__device__ int locate(const int* start, int count, int block) {
    __shared__ int found;
    int low = 0, n = count;
    while (n > 1) {
        int wide = (n + (int)blockDim.x - 1) / (int)blockDim.x;
        int first = low + (int)threadIdx.x * wide, last = min(first + wide, low + n);
        if (first < last && start[first] <= block && block < start[last]) found = first;
        __syncthreads();
        n = min(wide, low + n - found);
        low = found;
        __syncthreads();
    }
    return low;
}

// Assembles CHUNK nodes of a front per block, one column per warp: zeros, entries of A, then the children one by one.
extern "C" __global__ void __launch_bounds__(192)
assemble(const Front* fronts, const int* start, int count, const Front* all, const int* child, const int* map,
         const int* split, const Long* entry_start, const int* entry_block, const int* entry_row,
         const double* __restrict__ blocks, real* here, const real* __restrict__ there) {
    int index = locate(start, count, blockIdx.x);
    Front f = fronts[index];
    int chunk = blockIdx.x - start[index], warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    int first = CHUNK * chunk, last = min(first + CHUNK, f.rows / 3);
    real* front = here + f.at;
    int j = 3 * first + warp;
    if (j < 3 * last)
        for (int i = 3 * (j / 3) + lane; i < f.rows; i += 32) front[i + (Long)j * f.stride] = 0;
    __syncthreads();
    for (int node = first; node < min(last, f.own / 3); node++) {
        int k = f.column / 3 + node;
        Long e0 = entry_start[k];
        int entries = 9 * (int)(entry_start[k + 1] - e0);
        for (int t = threadIdx.x; t < entries; t += 192) {
            Long e = e0 + t / 9;
            int q = t % 9;
            front[3 * entry_row[e] + q / 3 + (Long)(3 * node + q % 3) * f.stride] = blocks[9 * (Long)entry_block[e] + q];
        }
    }
    for (int i = 0; i < f.children; i++) {
        __syncthreads();
        Front c = all[child[f.child + i]];
        const int* to = map + c.map;
        int u = 3 * split[c.split + chunk] + warp, end = 3 * split[c.split + chunk + 1];
        if (u >= end) continue;  // at most 3 CHUNK columns go here: one for each warp
        int below = c.rows - c.own;
        const real* from = there + c.at + (Long)(c.own + u) * c.stride + c.own;
        real* column = front + (Long)(3 * to[u / 3] + u % 3) * f.stride;
        for (int r = u + lane; r < below; r += 256) {
            real* entry[8];
            real sum[8];
#pragma unroll
            for (int a = 0; a < 8; a++) {
                int row = r + 32 * a;
                bool in = row < below;
                entry[a] = in ? column + 3 * to[row / 3] + row % 3 : 0;
                sum[a] = in ? *entry[a] + from[row] : 0;
            }
#pragma unroll
            for (int a = 0; a < 8; a++)
                if (entry[a]) *entry[a] = sum[a];
        }
    }
}

__device__ double rsqrt_of(double v) { return rsqrt(v); }
__device__ float rsqrt_of(float v) { return 1 / sqrtf(v); }

// Cholesky factor and inverse of 32 x 32 entries in shared memory, by one warp with a row in each lane, column by column.
// s holds the remaining entries of A to the right of the current column, and to its left the inverse, whose rows are not
// divided by their pivots yet. Result: L below the diagonal, the transposed inverse above it, 1 / diagonal in `reciprocal`.
__device__ void eliminate(real* m, real* reciprocal, int active, int column, FactorStatus* status) {
    int i = LANE;
    real s[32], own = 1;
#pragma unroll
    for (int c = 0; c < 32; c++) s[c] = c <= i ? m[c * PITCH + i] : 0;
#pragma unroll
    for (int j = 0; j < 32; j++) {
        if (j >= active) break;
        if (i == j)
#pragma unroll
            for (int c = 0; c < j; c++) m[j * PITCH + c] = s[c];
        real pivot = __shfl_sync(~0u, s[j], j);
        if (!(pivot > 0)) {
            if (i == 0) atomicMin(&status->pivot, column + j);
            pivot = 1;
        }
        real r = rsqrt_of(pivot), l = i > j ? s[j] * r : 0;
        if (i == j) own = r;
        if (i >= j) m[j * PITCH + i] = i == j ? pivot * r : l;
        __syncwarp();
        real lr = l * r;
        s[j] = i == j ? 1 : -lr;
#pragma unroll
        for (int c = j + 1; c < 32; c++) s[c] -= l * m[j * PITCH + c];
#pragma unroll
        for (int c = 0; c < j; c++) s[c] -= lr * m[j * PITCH + c];
    }
    __syncwarp();
    reciprocal[i] = own;
#pragma unroll
    for (int c = 0; c < 32; c++)
        if (c < i) m[i * PITCH + c] = s[c] * own;
}

// Entry [i][q] of the inverse, as `eliminate` stores it in m.
__device__ real inverse_entry(const real* m, const real* reciprocal, int i, int q) {
    return q < i ? m[i * PITCH + q] : q == i ? reciprocal[i] : 0;
}

// Factor and inverse of a block in halves of 32: [m .; under corner]; each warp has 8 rows or columns.
struct HalfBlocks {
    real *m, *under, *corner, *reciprocal;
    int first;

    // Makes `under` the lower left quarter of the factor, and subtracts under under^T from `corner`.
    __device__ void divide() {
        real x[8] = {};
        for (int q = 0; q < first + 8; q++) {
            real v = under[q * PITCH + LANE];
#pragma unroll
            for (int a = 0; a < 8; a++) x[a] += v * inverse_entry(m, reciprocal, first + a, q);
        }
        __syncthreads();
#pragma unroll
        for (int a = 0; a < 8; a++) under[(first + a) * PITCH + LANE] = x[a], x[a] = 0;
        __syncthreads();
#pragma unroll 4
        for (int q = 0; q < 32; q++) {
            real v = under[q * PITCH + LANE];
#pragma unroll
            for (int a = 0; a < 8; a++) x[a] += v * under[q * PITCH + first + a];
        }
#pragma unroll
        for (int a = 0; a < 8; a++)
            if (first + a <= LANE) corner[(first + a) * PITCH + LANE] -= x[a];
    }

    // By warps 1 to 3: writes `under` times the inverse to the lower left quarter of the inverse (transposed).
    __device__ void multiply() {
        real y[11] = {};
        int top = 11 * (WARP - 1);
#pragma unroll 2
        for (int q = 0; q < 32; q++) {
            real v = inverse_entry(m, reciprocal, q, LANE);
#pragma unroll
            for (int a = 0; a < 11; a++) y[a] += under[q * PITCH + min(top + a, 31)] * v;
        }
#pragma unroll
        for (int a = 0; a < 11; a++)
            if (top + a < 32) m[(32 + top + a) * PITCH + LANE] = y[a];
    }

    // Multiplies this quarter by the inverse of the corner.
    __device__ void finish() {
        real x[8] = {};
        for (int q = 0; q < first + 8; q++) {
            real v = m[(32 + q) * PITCH + LANE];
#pragma unroll
            for (int a = 0; a < 8; a++) x[a] -= inverse_entry(corner, reciprocal + 32, first + a, q) * v;
        }
        __syncthreads();
#pragma unroll
        for (int a = 0; a < 8; a++) m[(32 + first + a) * PITCH + LANE] = x[a];
    }
};

// Factorizes the leading w x w entries (w <= 64) of `block` in place, its inverse transposed above the diagonal.
// m: 64 columns of shared memory.
__device__ void diagonal(real* m, real* block, int stride, int w, int column, FactorStatus* status) {
    __shared__ real reciprocal[WIDTH];
    HalfBlocks halves = {m, m + 32, m + 32 * PITCH + 32, reciprocal, 8 * WARP};
    int r = threadIdx.x % 64, c0 = threadIdx.x / 64;
    real v[WIDTH / 2];
#pragma unroll
    for (int i = 0; i < WIDTH / 2; i++) {
        int c = c0 + 2 * i;
        v[i] = r < w && c <= r ? block[r + (Long)c * stride] : real(r == c);
    }
#pragma unroll
    for (int i = 0; i < WIDTH / 2; i++) m[(c0 + 2 * i) * PITCH + r] = v[i];
    __syncthreads();
#pragma unroll 1
    for (int half = 0; 32 * half < w; half++) {
        if (WARP == 0)
            eliminate(m + 32 * half * (PITCH + 1), reciprocal + 32 * half, w - 32 * half, column + 32 * half, status);
        else if (half)
            halves.multiply();
        __syncthreads();
        if (half)
            halves.finish();
        else if (w > 32)
            halves.divide();
        __syncthreads();
    }
#pragma unroll 8
    for (int c = c0; c < w; c += 2)
        if (r < w) block[r + (Long)c * stride] = m[c * PITCH + r];
}

extern "C" __global__ void __launch_bounds__(THREADS) factor(const Front* fronts, real* here, FactorStatus* status) {
    __shared__ __align__(16) real work[2 * DEEP * PITCH];
    Front f = fronts[blockIdx.x];
    diagonal(work, here + f.at, f.stride, min(WIDTH, f.own), f.column, status);
}

// Tiles of 64 x 64 sums, 32 in each thread: row and column of the e-th of them, and the addition of a b^T for DEEP columns.
#if __CUDA_ARCH__ >= 800
struct TensorCoreTiles {  // float64 matrix instructions: a warp has 32 x 32 sums, 4 x 4 squares of 8 x 8
    __device__ static int row(int e) { return 32 * (WARP % 2) + 8 * (e / 8) + LANE / 4; }
    __device__ static int column(int e) { return 32 * (WARP / 2) + 8 * (e / 2 % 4) + 2 * (LANE % 4) + e % 2; }
    __device__ static void multiply(double& s0, double& s1, double a, double b) {
        asm volatile("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0, %1}, {%2}, {%3}, {%0, %1};"
                     : "+d"(s0), "+d"(s1) : "d"(a), "d"(b));
    }
    __device__ static void add(double* sum, const double* a, const double* b) {
        const double* x = a + (LANE % 4) * PITCH + 32 * (WARP % 2) + LANE / 4;
        const double* y = b + (LANE % 4) * PITCH + 32 * (WARP / 2) + LANE / 4;
#pragma unroll
        for (int k = 0; k < DEEP; k += 4) {
            double p[4], q[4];
#pragma unroll
            for (int i = 0; i < 4; i++) p[i] = x[k * PITCH + 8 * i], q[i] = y[k * PITCH + 8 * i];
#pragma unroll
            for (int i = 0; i < 4; i++)
#pragma unroll
                for (int j = 0; j < 4; j++) multiply(sum[8 * i + 2 * j], sum[8 * i + 2 * j + 1], p[i], q[j]);
        }
    }
};
#endif

struct ScalarTiles {  // a thread has 4 x 8 sums
    __device__ static int row(int e) { return threadIdx.x % 16 + 16 * (e / 8); }
    __device__ static int column(int e) { return 8 * (threadIdx.x / 16) + e % 8; }
    __device__ static void add(real* sum, const real* a, const real* b) {
        const real *x = a + threadIdx.x % 16, *y = b + 8 * (threadIdx.x / 16);
#pragma unroll 4
        for (int k = 0; k < DEEP; k++) {
            real p[4], q[8];
#pragma unroll
            for (int i = 0; i < 4; i++) p[i] = x[k * PITCH + 16 * i];
#pragma unroll
            for (int j = 0; j < 8; j++) q[j] = y[k * PITCH + j];
#pragma unroll
            for (int i = 0; i < 4; i++)
#pragma unroll
                for (int j = 0; j < 8; j++) sum[8 * i + j] += p[i] * q[j];
        }
    }
};

template <class T> struct TilesOf { typedef ScalarTiles Tiles; };
#if __CUDA_ARCH__ >= 800
template <> struct TilesOf<double> { typedef TensorCoreTiles Tiles; };
#endif
typedef TilesOf<real>::Tiles Tiles;

// Loads 64 rows of DEEP columns into shared memory; zeros outside of rows x columns. Here and below all reads come before
// all writes, since a read waits for an earlier write that may be to the same address.
__device__ void load(real* to, const real* from, int stride, int rows, int columns) {
    int r = threadIdx.x % 64, k = threadIdx.x / 64;
    real v[DEEP / 2];
#pragma unroll
    for (int i = 0; i < DEEP / 2; i++)
        v[i] = r < rows && 2 * i + k < columns ? from[r + (Long)(2 * i + k) * stride] : 0;
#pragma unroll
    for (int i = 0; i < DEEP / 2; i++) to[(2 * i + k) * PITCH + r] = v[i];
}

// Loads DEEP columns, from q0 on, of the inverse of a factorized diagonal block.
__device__ void load_inverse(real* to, const real* block, int stride, int w, int q0) {
    const int APART = THREADS / DEEP;
    int k = threadIdx.x % DEEP, q = q0 + k, c0 = threadIdx.x / DEEP;
    real v[WIDTH / APART];
#pragma unroll
    for (int i = 0; i < WIDTH / APART; i++) {
        int c = c0 + APART * i;
        v[i] = c < w && q < c ? block[q + (Long)c * stride] : 0;
    }
    real pivot = c0 == 0 && q < w ? block[q + (Long)q * stride] : 1;
#pragma unroll
    for (int i = 0; i < WIDTH / APART; i++)
        if (c0 + APART * i != q) to[k * PITCH + c0 + APART * i] = v[i];
    if (c0 == 0) to[k * PITCH + q] = 1 / pivot;
}

extern "C" __global__ void __launch_bounds__(THREADS, 3)
panel(const Front* fronts, const int* start, int count, int step, real* here) {
    __shared__ __align__(16) real work[2 * DEEP * PITCH];
    real *a = work, *b = work + DEEP * PITCH;
    int index = locate(start, count, blockIdx.x);
    Front f = fronts[index];
    int d = WIDTH * step, w = min(WIDTH, f.own - d), top = d + w + 64 * (blockIdx.x - start[index]);
    int rows = min(64, f.rows - top);
    const real* block = here + f.at + d + (Long)d * f.stride;
    real* tile = here + f.at + top + (Long)d * f.stride;
    real sum[32] = {};
    for (int k = 0; k < w; k += DEEP) {
        __syncthreads();
        load(a, tile + (Long)k * f.stride, f.stride, rows, w - k);
        load_inverse(b, block, f.stride, w, k);
        __syncthreads();
        Tiles::add(sum, a, b);
    }
#pragma unroll
    for (int e = 0; e < 32; e++) {
        int i = Tiles::row(e), j = Tiles::column(e);
        if (i < rows && j < w) tile[i + (Long)j * f.stride] = sum[e];
    }
}

extern "C" __global__ void __launch_bounds__(THREADS, 3)
update(const Front* fronts, const int* start, int count, int step, real* here, FactorStatus* status) {
    __shared__ __align__(16) real work[2 * DEEP * PITCH];
    real *a = work, *b = work + DEEP * PITCH;
    int index = locate(start, count, blockIdx.x);
    Front f = fronts[index];
    int number = blockIdx.x - start[index];  // tiles of a lower triangle, row by row
    int i = (int)((sqrtf(8.0f * number + 1) - 1) / 2);
    while (i * (i + 1) / 2 > number) i--;
    while ((i + 1) * (i + 2) / 2 <= number) i++;
    int j = number - i * (i + 1) / 2;
    int d = WIDTH * step, w = min(WIDTH, f.own - d), base = d + w, top = base + 64 * i, left = base + 64 * j;
    int rows = min(64, f.rows - top), columns = min(64, f.rows - left);
    const real* front = here + f.at + (Long)d * f.stride;
    real sum[32] = {};
    for (int k = 0; k < w; k += DEEP) {
        __syncthreads();
        load(a, front + top + (Long)k * f.stride, f.stride, rows, w - k);
        load(b, front + left + (Long)k * f.stride, f.stride, columns, w - k);
        __syncthreads();
        Tiles::add(sum, a, b);
    }
    real* tile = here + f.at + top + (Long)left * f.stride;
#pragma unroll
    for (int half = 0; half < 2; half++) {
        real v[16];
#pragma unroll
        for (int e = 0; e < 16; e++) {
            int r = Tiles::row(16 * half + e), c = Tiles::column(16 * half + e);
            v[e] = r < rows && c < columns ? tile[r + (Long)c * f.stride] : 0;
        }
#pragma unroll
        for (int e = 0; e < 16; e++) {
            int r = Tiles::row(16 * half + e), c = Tiles::column(16 * half + e);
            if (r < rows && c < columns) tile[r + (Long)c * f.stride] = v[e] - sum[16 * half + e];
        }
    }
    if (number == 0 && base < f.own) {
        __syncthreads();
        diagonal(work, tile, f.stride, min(WIDTH, f.own - base), f.column + base, status);
    }
}

// Copies columns of L, one per warp, to their positions in the pattern.
extern "C" __global__ void __launch_bounds__(192)
store(const Front* fronts, const int* start, int count, const real* __restrict__ here, Value* __restrict__ values,
      FactorStatus* status) {
    const Value tiny = sizeof(Value) == 4 ? Value(1.17549435e-38f) : Value(2.2250738585072014e-308);
    int index = locate(start, count, blockIdx.x);
    Front f = fronts[index];
    int j = 6 * (blockIdx.x - start[index]) + threadIdx.x / 32;
    if (j >= f.own) return;
    const real* column = here + f.at + (Long)j * f.stride;
    Value* out = values + f.value + (Long)j * f.rows - (Long)j * (j - 1) / 2 - j;
    bool fine = true;
#pragma unroll 8
    for (int i = j + threadIdx.x % 32; i < f.rows; i += 32) {
        Value v = column[i];
        out[i] = v;
        fine = fine && finite(v) && (i > j || v >= tiny);
    }
    if (!fine) atomicMin(&status->range, f.column + j);
}

// Whether a pivot of L is no more than rounding error of the largest diagonal entry of its node in A. diagonal: where values of L
// are on its diagonal; block: of A on the diagonal, of the node of each column.
extern "C" __global__ void check_pivots(const Value* values, const Long* diagonal, const int* block, int columns, const double* blocks,
                                        double threshold, int* unsound) {
    for (int i = blockIdx.x * blockDim.x + threadIdx.x; i < columns; i += gridDim.x * blockDim.x) {
        const double pivot = (double)values[diagonal[i]], *a = blocks + 9 * (Long)block[i];
        const double largest = fmax(fabs(a[0]), fmax(fabs(a[4]), fabs(a[8])));
        if (!(pivot * pivot > threshold * largest)) *unsound = 1;
    }
}
