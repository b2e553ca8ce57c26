// SPDX-License-Identifier: MIT
// How much a rounded inverse of a factor spoils, as digits.cpp estimates it, for an L that is on the device: the largest A_ii (A^-1)_ii.
// L^T Y = G is solved for 16 right-hand sides of random signs, supernode by supernode from the last one on, in one launch: a thread
// block takes the next supernode and waits until its parent, and so all its ancestors, are done. GPU only; sums have a fixed order.
constexpr int PROBES = 16;   // right-hand sides
constexpr int THREADS = 512;
constexpr int COLUMNS = 32;  // of a supernode that are solved together
constexpr int SHARE = 4;     // of these, columns whose products a warp forms
constexpr int SLICES = THREADS / 32 / (COLUMNS / SHARE);  // into which their rows are split
constexpr int ROWS = 128;    // of a supernode that a thread block squares together
#define KERNEL_OF(threads) extern "C" __global__ void __launch_bounds__(threads)

struct Supernode {
    long long values, rows;            // its first value, and its first row in the row lists
    int first, width, height, parent;  // first column; parent: -1 without one
};

struct RowsOfSupernode { int supernode, first; };

// Random signs of a degree of freedom (SplitMix64), as in digits.cpp.
__device__ unsigned signs_of(unsigned long long i) {
    unsigned long long x = (i + 1) * 0x9e3779b97f4a7c15ull;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9ull;
    x = (x ^ x >> 27) * 0x94d049bb133111ebull;
    return (unsigned)(x ^ x >> 31);
}

// Where the value of row 0 of a column would be: rows and columns are counted from the first of the supernode.
__device__ __forceinline__ const float* column_of(const Supernode& s, const float* values, int column) {
    return values + s.values + (long long)column * s.height - (long long)column * (column - 1) / 2 - column;
}

// Sums of 64 numbers of each lane: lane k gets numbers 2 k and 2 k + 1.
__device__ __forceinline__ void sum_lanes(float (&x)[SHARE * PROBES], int lane) {
#pragma unroll
    for (int by = 16, n = SHARE * PROBES / 2; by > 0; by /= 2, n /= 2) {
        const bool upper = lane & by;
#pragma unroll
        for (int i = 0; i < n; i++) {
            const float sent = upper ? x[i] : x[i + n], kept = upper ? x[i + n] : x[i];
            x[i] = kept + __shfl_xor_sync(0xffffffffu, sent, by);
        }
    }
}

// state: number of supernodes taken, then for each whether it is done; all 0 at first. y: (n, PROBES)
KERNEL_OF(THREADS) solve_probes(const Supernode* supernodes, int count, const int* rows, const float* values, float4* y, int* state) {
    __shared__ float products[SLICES][COLUMNS][PROBES];
    __shared__ float diagonal[COLUMNS][COLUMNS + 1];  // [column][row]
    __shared__ int taken;
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const int share = warp % (COLUMNS / SHARE) * SHARE, slice = warp / (COLUMNS / SHARE);
    for (;;) {
        if (threadIdx.x == 0) taken = atomicAdd(state, 1);
        __syncthreads();
        const int number = count - 1 - taken;
        __syncthreads();
        if (number < 0) return;
        const Supernode s = supernodes[number];
        if (s.parent >= 0) {
            if (threadIdx.x == 0) {
                while (atomicAdd(state + 1 + s.parent, 0) == 0) __nanosleep(100);
                __threadfence();
            }
            __syncthreads();
        }
        for (int end = s.width; end > 0;) {
            const int begin = (end - 1) / COLUMNS * COLUMNS, columns = end - begin;
            for (int e = threadIdx.x; e < COLUMNS * COLUMNS; e += THREADS) {
                const int column = e / COLUMNS, row = e % COLUMNS;
                if (column <= row && row < columns) diagonal[column][row] = column_of(s, values, begin + column)[begin + row];
            }
            if (share < columns) {  // products of the rows below, which are solved already
                float sum[SHARE * PROBES] = {};
                const float* column[SHARE];
                for (int c = 0; c < SHARE; c++) column[c] = column_of(s, values, begin + (share + c < columns ? share + c : share));
#pragma unroll 2
                for (int row = end + 32 * slice + lane; row < s.height; row += 32 * SLICES) {
                    const float4* solved = y + 4ll * rows[s.rows + row];
                    float4 x[PROBES / 4];
#pragma unroll
                    for (int k = 0; k < PROBES / 4; k++) x[k] = __ldcg(solved + k);
#pragma unroll
                    for (int c = 0; c < SHARE; c++) {
                        const float l = column[c][row];
#pragma unroll
                        for (int k = 0; k < PROBES / 4; k++) {
                            float* to = sum + PROBES * c + 4 * k;
                            to[0] += l * x[k].x;
                            to[1] += l * x[k].y;
                            to[2] += l * x[k].z;
                            to[3] += l * x[k].w;
                        }
                    }
                }
                sum_lanes(sum, lane);
                float* to = products[slice][share + 2 * lane / PROBES] + 2 * lane % PROBES;
                to[0] = sum[0];
                to[1] = sum[1];
            }
            __syncthreads();
            for (int probe = warp; probe < PROBES; probe += THREADS / 32) {  // a lane has a column
                const unsigned signs = signs_of(s.first + begin + lane);
                float x = (signs >> probe & 1) ? 1.f : -1.f;
                if (lane < columns)
                    for (int k = 0; k < SLICES; k++) x -= products[k][lane][probe];
                for (int j = columns - 1; j >= 0; j--) {
                    const float solved = __shfl_sync(0xffffffffu, x, j) / diagonal[j][j];
                    if (lane == j) x = solved;
                    if (lane < j) x -= diagonal[lane][j] * solved;
                }
                if (lane < columns) ((float*)y)[(long long)PROBES * (s.first + begin + lane) + probe] = x;
            }
            __threadfence();
            __syncthreads();
            end = begin;
        }
        if (threadIdx.x == 0) atomicAdd(state + 1 + number, 1);
    }
}

// Sums of squares of the rows of each supernode, in the order of the row lists.
KERNEL_OF(ROWS) square_rows(const RowsOfSupernode* tasks, int count, const Supernode* supernodes, const float* values, float* squares) {
    for (int t = blockIdx.x; t < count; t += gridDim.x) {
        const Supernode s = supernodes[tasks[t].supernode];
        const int row = tasks[t].first + threadIdx.x;
        if (row >= s.height) continue;
        float sum = 0;
        const int columns = row < s.width ? row + 1 : s.width;
#pragma unroll 8
        for (int column = 0; column < columns; column++) {
            const float l = column_of(s, values, column)[row];
            sum += l * l;
        }
        squares[s.rows + row] = sum;
    }
}

// The largest A_ii (A^-1)_ii as bits of a double, NaN above all numbers; 0 at first. start, list: where squares of each row of L are.
KERNEL_OF(256) find_largest(int n, const int* start, const int* list, const float* squares, const float* y, long long* largest) {
    long long found = 0;
    for (int i = blockIdx.x * blockDim.x + threadIdx.x; i < n; i += gridDim.x * blockDim.x) {
        float square = 0;
        for (int k = start[i]; k < start[i + 1]; k++) square += squares[list[k]];
        double sum = 0;
        for (int k = 0; k < PROBES; k++) {
            const double each = y[(long long)PROBES * i + k];
            sum += each * each;
        }
        const double response = square * sum / PROBES;
        const long long bits = response == response ? __double_as_longlong(response) : 0x7ff8000000000000ll;
        found = bits > found ? bits : found;
    }
    for (int by = 16; by > 0; by /= 2) {
        const long long other = __shfl_xor_sync(0xffffffffu, found, by);
        found = other > found ? other : found;
    }
    if (threadIdx.x % 32 == 0) atomicMax(largest, found);
}
