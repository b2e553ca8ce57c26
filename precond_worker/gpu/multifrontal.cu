// SPDX-License-Identifier: MIT
// Multifrontal Cholesky factorization of many fronts at a time (plan.py says what a front is, numeric.py launches).
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

struct Front {
    Long at, value, child, map, split;  // see Plan
    int own, rows, stride, column;
    int children, unused;
};

struct Status {
    int pivot;     // first column of L whose pivot was not positive
    int range;     // first column with a value outside the range of Value
    int infinite;  // a value of A is NaN or infinite
};

extern "C" __global__ void reset(Status* status) { *status = Status{0x7fffffff, 0x7fffffff, 0}; }

template <class T> __device__ bool finite(T v) { return v - v == 0; }

extern "C" __global__ void look(const double* blocks, Long count, Status* status) {
    for (Long i = blockIdx.x * (Long)blockDim.x + threadIdx.x; i < count; i += (Long)gridDim.x * blockDim.x)
        if (!finite(blocks[i])) status->infinite = 1;
}

// The i with start[i] <= block < start[i + 1], found by all threads of a block together.
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

// One block per CHUNK nodes of a front, one warp per column: zeros, entries of A, then child after child.
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
        for (int r = u + lane; r < below; r += 128) {
            real* entry[4];
            real sum[4];
#pragma unroll
            for (int a = 0; a < 4; a++) {
                int row = r + 32 * a;
                bool in = row < below;
                entry[a] = in ? column + 3 * to[row / 3] + row % 3 : 0;
                sum[a] = in ? *entry[a] + from[row] : 0;
            }
#pragma unroll
            for (int a = 0; a < 4; a++)
                if (entry[a]) *entry[a] = sum[a];
        }
    }
}

__device__ double rsqrt_of(double v) { return rsqrt(v); }
__device__ float rsqrt_of(float v) { return 1 / sqrtf(v); }

// Factorizes the leading w x w entries (w <= 64) of `block` in place, its inverse transposed above the diagonal.
// Column by column; each thread keeps 4 x 8 entries of a matrix in registers that is what remains of A right of the
// current column and the inverse left of it, and all share what the current column needs.
__device__ void diagonal(real* block, int stride, int w, int column, Status* status) {
    __shared__ real shared_column[2][WIDTH], shared_row[2][WIDTH];
    int ti = threadIdx.x % 16, tc = threadIdx.x / 16;  // rows ti + 16 a, columns tc + 8 b
    real s[4][8];
#pragma unroll
    for (int a = 0; a < 4; a++)
#pragma unroll
        for (int b = 0; b < 8; b++) {
            int i = ti + 16 * a, c = tc + 8 * b;
            s[a][b] = i < w && c <= i ? block[i + (Long)c * stride] : real(i == c);
        }
#pragma unroll
    for (int jb = 0; jb < 8; jb++)
#pragma unroll 1
        for (int jc = 0; jc < 8; jc++) {
            int j = 8 * jb + jc;
            if (j >= w) break;
            real *col = shared_column[j % 2], *row = shared_row[j % 2];
            if (tc == jc)
#pragma unroll
                for (int a = 0; a < 4; a++) col[ti + 16 * a] = s[a][jb];
            if (ti == j % 16)
#pragma unroll
                for (int b = 0; b < 8; b++) row[tc + 8 * b] = s[jb / 2][b];
            __syncthreads();  // once a column: the two buffers are used in turn
            real pivot = col[j];
            if (!(pivot > 0)) {
                if (threadIdx.x == 0) atomicMin(&status->pivot, column + j);
                pivot = 1;
            }
            real r = rsqrt_of(pivot), l[4];
#pragma unroll
            for (int a = 0; a < 4; a++) l[a] = ti + 16 * a >= j ? col[ti + 16 * a] * r : 0;
            if (tc == jc)
#pragma unroll
                for (int a = 0; a < 4; a++) {
                    int i = ti + 16 * a;
                    if (i >= j && i < w) block[i + (Long)j * stride] = i == j ? pivot * r : l[a];
                }
#pragma unroll
            for (int b = 0; b < 8; b++) {
                int c = tc + 8 * b;
                real v = c > j ? col[c] * r : c < j ? row[c] * r : r;  // scaled row j of what is kept
#pragma unroll
                for (int a = 0; a < 4; a++) {
                    int i = ti + 16 * a;
                    if (i > j) s[a][b] = (c == j ? 0 : s[a][b]) - l[a] * v;
                    if (i == j && c <= j) s[a][b] = v;
                }
            }
        }
#pragma unroll
    for (int a = 0; a < 4; a++)
#pragma unroll
        for (int b = 0; b < 8; b++) {
            int i = ti + 16 * a, c = tc + 8 * b;
            if (c < i && i < w) block[c + (Long)i * stride] = s[a][b];
        }
}

extern "C" __global__ void __launch_bounds__(THREADS) factor(const Front* fronts, real* here, Status* status) {
    Front f = fronts[blockIdx.x];
    diagonal(here + f.at, f.stride, min(WIDTH, f.own), f.column, status);
}

// Tiles of 64 x 64 sums, 32 of them in each thread: where they stand, and adding a b^T of DEEP columns of a and b.
#define LANE (int(threadIdx.x) % 32)
#define WARP (int(threadIdx.x) / 32)

template <class T> struct Product;

template <> struct Product<double> {  // a warp has 32 x 32 sums, 4 x 4 squares of 8 x 8
    __device__ static int row(int e) { return 32 * (WARP % 2) + 8 * (e / 8) + LANE / 4; }
    __device__ static int column(int e) { return 32 * (WARP / 2) + 8 * (e / 2 % 4) + 2 * (LANE % 4) + e % 2; }
    __device__ static void multiply(double& s0, double& s1, double a, double b) {
#if __CUDA_ARCH__ >= 800
        asm volatile("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0, %1}, {%2}, {%3}, {%0, %1};"
                     : "+d"(s0), "+d"(s1) : "d"(a), "d"(b));
#else
#pragma unroll
        for (int k = 0; k < 4; k++) {
            double x = __shfl_sync(~0u, a, 4 * (LANE / 4) + k);
            s0 += x * __shfl_sync(~0u, b, 4 * (2 * (LANE % 4)) + k);
            s1 += x * __shfl_sync(~0u, b, 4 * (2 * (LANE % 4) + 1) + k);
        }
#endif
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

template <> struct Product<float> {
    __device__ static int row(int e) { return threadIdx.x % 16 + 16 * (e / 8); }
    __device__ static int column(int e) { return 8 * (threadIdx.x / 16) + e % 8; }
    __device__ static void add(float* sum, const float* a, const float* b) {
        const float *x = a + threadIdx.x % 16, *y = b + 8 * (threadIdx.x / 16);
#pragma unroll 8
        for (int k = 0; k < DEEP; k++) {
            float p[4], q[8];
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

typedef Product<real> Tiles;

// 64 rows of DEEP columns into shared memory; zeros outside of rows x columns.
__device__ void load(real* to, const real* from, int stride, int rows, int columns) {
    int r = threadIdx.x % 64, k = threadIdx.x / 64;
#pragma unroll 16
    for (int i = 0; i < DEEP; i += 2)
        to[(i + k) * PITCH + r] = r < rows && i + k < columns ? from[r + (Long)(i + k) * stride] : 0;
}

// DEEP columns, from q0 on, of the inverse of a factorized diagonal block.
__device__ void load_inverse(real* to, const real* block, int stride, int w, int q0) {
    int k = threadIdx.x % DEEP, q = q0 + k;
#pragma unroll 16
    for (int c = threadIdx.x / DEEP; c < WIDTH; c += THREADS / DEEP) {
        real v = 0;
        if (c < w && q <= c) v = block[q + (Long)c * stride];
        to[k * PITCH + c] = q == c && c < w ? 1 / v : v;
    }
}

extern "C" __global__ void __launch_bounds__(THREADS)
panel(const Front* fronts, const int* start, int count, int step, real* here) {
    __shared__ __align__(16) real a[DEEP * PITCH], b[DEEP * PITCH];
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

extern "C" __global__ void __launch_bounds__(THREADS)
update(const Front* fronts, const int* start, int count, int step, real* here, Status* status) {
    __shared__ __align__(16) real a[DEEP * PITCH], b[DEEP * PITCH];
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
    for (int e = 0; e < 32; e++) {
        int r = Tiles::row(e), c = Tiles::column(e);
        if (r < rows && c < columns) tile[r + (Long)c * f.stride] -= sum[e];
    }
    if (number == 0 && base < f.own) {
        __syncthreads();
        diagonal(tile, f.stride, min(WIDTH, f.own - base), f.column + base, status);
    }
}

// Columns of L, one warp each, to where the pattern has them.
extern "C" __global__ void __launch_bounds__(192)
store(const Front* fronts, const int* start, int count, const real* here, Value* values, Status* status) {
    const Value tiny = sizeof(Value) == 4 ? Value(1.17549435e-38f) : Value(2.2250738585072014e-308);
    int index = locate(start, count, blockIdx.x);
    Front f = fronts[index];
    int j = 6 * (blockIdx.x - start[index]) + threadIdx.x / 32;
    if (j >= f.own) return;
    const real* column = here + f.at + (Long)j * f.stride;
    Value* out = values + f.value + (Long)j * f.rows - (Long)j * (j - 1) / 2 - j;
    bool fine = true;
    for (int i = j + threadIdx.x % 32; i < f.rows; i += 32) {
        Value v = column[i];
        out[i] = v;
        fine = fine && finite(v) && (i > j || v >= tiny);
    }
    if (!fine) atomicMin(&status->range, f.column + j);
}
