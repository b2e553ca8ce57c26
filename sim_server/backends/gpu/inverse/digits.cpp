// SPDX-License-Identifier: MIT
// How much a rounded inverse of a factor spoils (digits.py): A_ii (A^-1)_ii, the largest of all degrees of freedom, of A = L L^T.
//
// A_ii is the square of row i of L. (A^-1)_ii is estimated: L^T y = g has E[y_i^2] = (A^-1)_ii for independent random signs g
// (Hutchinson 1990; Bekas, Kokiopoulou, Saad, An estimator for the diagonal of a matrix, 2007). The signs are the same each time.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <thread>
#include <vector>

namespace {

constexpr int PROBES = 16;  // right-hand sides g, solved together: L is read once

typedef float Eight __attribute__((vector_size(32)));

struct Row {  // of all right-hand sides
    Eight low, high;

    void subtract(float factor, const Row& y) {
        low -= factor * y.low;
        high -= factor * y.high;
    }
    float operator[](int k) const { return k < 8 ? low[k] : high[k - 8]; }
};

// Random signs of a degree of freedom (SplitMix64).
uint32_t bits(uint64_t i) {
    uint64_t x = (i + 1) * 0x9e3779b97f4a7c15u;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9u;
    x = (x ^ x >> 27) * 0x94d049bb133111ebu;
    return uint32_t(x ^ x >> 31);
}

// x = (g - sum of column[r] y[r], r = 1 .. length - 1) / column[0]
void solve(const float* column, const Row* y, int64_t length, uint32_t signs, Row& x) {
    Row a{}, b{}, c{}, d{};  // partial sums, so that an addition does not wait for the one before
    alignas(Row) float g[PROBES];
    for (int k = 0; k < PROBES; k++) g[k] = float(int(signs >> k & 1) * 2 - 1);
    std::memcpy(&a, g, sizeof(Row));
    int64_t r = 1;
    for (; r + 4 <= length; r += 4) {
        a.subtract(column[r], y[r]);
        b.subtract(column[r + 1], y[r + 1]);
        c.subtract(column[r + 2], y[r + 2]);
        d.subtract(column[r + 3], y[r + 3]);
    }
    for (; r < length; r++) a.subtract(column[r], y[r]);
    x.low = (a.low + b.low + (c.low + d.low)) / column[0];
    x.high = (a.high + b.high + (c.high + d.high)) / column[0];
}

double largest_response(int64_t supernodes, const int32_t* super_start, const int64_t* row_start, const int32_t* rows,
                        const int64_t* value_start, const float* values) {
    const int64_t size = super_start[supernodes];
    std::vector<Row> y(size), own;
    std::vector<float> squares(size), below;  // of the rows of L
    for (int64_t s = supernodes - 1; s >= 0; s--) {
        const int64_t width = super_start[s + 1] - super_start[s], height = row_start[s + 1] - row_start[s];
        const int32_t* row = rows + row_start[s];
        own.resize(height);
        below.assign(height, 0);
        for (int64_t r = width; r < height; r++) own[r] = y[row[r]];
        for (int64_t j = width - 1; j >= 0; j--) {
            const float* column = values + value_start[s] + j * height - j * (j - 1) / 2;
            solve(column, &own[j], height - j, bits(row[j]), own[j]);
            for (int64_t r = j; r < height; r++) below[r] += column[r - j] * column[r - j];
        }
        std::copy(own.begin(), own.begin() + width, y.begin() + row[0]);
        for (int64_t r = 0; r < height; r++) squares[row[r]] += below[r];
    }
    double largest = 0;
    for (int64_t i = 0; i < size; i++) {
        double sum = 0;
        for (int k = 0; k < PROBES; k++) sum += double(y[i][k]) * y[i][k];
        const double response = squares[i] * sum / PROBES;
        if (std::isnan(response)) return response;
        largest = std::max(largest, response);
    }
    return largest;
}

}  // namespace

extern "C" {

// super_start, row_start, rows, value_start: as in protocol/factor.py. values: of each of `count` L of this pattern. largest: of
// each, NaN or infinity where L has such values. threads: that share the work, this one among them.
void largest_responses(int64_t count, int64_t supernodes, const int32_t* super_start, const int64_t* row_start, const int32_t* rows,
                       const int64_t* value_start, const float* const* values, double* largest, int32_t threads) {
    std::atomic<int64_t> next{0};
    auto work = [&] {
        for (int64_t i = next++; i < count; i = next++)
            largest[i] = largest_response(supernodes, super_start, row_start, rows, value_start, values[i]);
    };
    std::vector<std::thread> others;
    for (int32_t k = 1; k < threads; k++) others.emplace_back(work);
    work();
    for (std::thread& each : others) each.join();
}

}  // extern "C"
