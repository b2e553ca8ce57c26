// SPDX-License-Identifier: MIT
// Inverse of a matrix by one thread block, Gauss-Jordan elimination in place with pivots of 3x3 on the diagonal, without exchanges of rows.
#pragma once
#include "block_group.cuh"

constexpr double LEAST_PIVOT = 1e-14;  // of the determinant of a pivot, of a matrix whose eigenvalues are about 1

// a: (n, n), by its inverse. row, column: room for 3 n numbers each. least: of determinants. False if a pivot is not above it.
__device__ __noinline__ bool invert_by_pivots(double* a, int n, double* row, double* column, double least) {
    const int me = threadIdx.x;
    for (int p = 0; p < n; p += 3) {
        double d[9], inverse[9];
        for (int k = 0; k < 9; ++k) d[k] = a[(long long)(p + k / 3) * n + p + k % 3];
        const double det = d[0] * (d[4] * d[8] - d[5] * d[7]) - d[1] * (d[3] * d[8] - d[5] * d[6]) + d[2] * (d[3] * d[7] - d[4] * d[6]);
        if (!(det > least && det < 1e300)) return false;  // in all threads
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const int b = (j + 1) % 3, c = (j + 2) % 3, q = (i + 1) % 3, r = (i + 2) % 3;
                inverse[3 * i + j] = (d[3 * b + q] * d[3 * c + r] - d[3 * b + r] * d[3 * c + q]) / det;
            }
        for (int j = me; j < n; j += THREADS)
            for (int k = 0; k < 3; ++k) {
                row[k * n + j] = inverse[3 * k] * a[(long long)p * n + j] + inverse[3 * k + 1] * a[(long long)(p + 1) * n + j] +
                                 inverse[3 * k + 2] * a[(long long)(p + 2) * n + j];
                column[3 * j + k] = a[(long long)j * n + p + k];
            }
        __syncthreads();
        for (int i = me / 32; i < n; i += WARPS) {
            const bool in_row = i >= p && i < p + 3;
            const double f[3] = {column[3 * i], column[3 * i + 1], column[3 * i + 2]};
            double* to = a + (long long)i * n;
            for (int j = me % 32; j < n; j += 32) {
                const bool in_column = j >= p && j < p + 3;
                if (in_row) {
                    to[j] = in_column ? inverse[3 * (i - p) + j - p] : row[(i - p) * n + j];
                } else if (in_column) {
                    to[j] = -(f[0] * inverse[j - p] + f[1] * inverse[3 + j - p] + f[2] * inverse[6 + j - p]);
                } else {
                    to[j] -= f[0] * row[j] + f[1] * row[n + j] + f[2] * row[2 * n + j];
                }
            }
        }
        __syncthreads();
    }
    return true;
}
