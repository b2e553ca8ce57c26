// SPDX-License-Identifier: MIT
// Compares pivots of factors of one pattern with the diagonals of their matrices (pivots.py).

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

template <class Value>
bool sound(const Value* values, int64_t nodes, const int64_t* places, const double* scales, double threshold) {
    bool good = true;
    for (int64_t i = 0; i < nodes; i++)
        for (int64_t axis = 0; axis < 3; axis++) {
            const double pivot = values[places[3 * i + axis]];
            good &= pivot * pivot > threshold * scales[i];  // not of NaN
        }
    return good;
}

}  // namespace

extern "C" {

// scales (count, nodes): largest diagonal entry of the node's block, blocks (nodes,), of each matrix of `size` numbers.
void pivot_scales(int64_t count, int64_t size, const double* matrices, int64_t nodes, const int64_t* blocks, double* scales) {
    for (int64_t k = 0; k < count; k++, matrices += size)
        for (int64_t i = 0; i < nodes; i++) {
            const double* block = matrices + 9 * blocks[i];
            *scales++ = std::max({std::fabs(block[0]), std::fabs(block[4]), std::fabs(block[8])});
        }
}

// good (count,): whether all pivots of a factor, of `size` numbers of 4 or 8 bytes, are sound. places (nodes, 3): of the pivots.
void pivots_sound(int64_t count, int64_t size, const char* values, int32_t item, int64_t nodes, const int64_t* places,
                  const double* scales, double threshold, uint8_t* good) {
    for (int64_t k = 0; k < count; k++, values += size * item, scales += nodes)
        good[k] = item == 8 ? sound((const double*)values, nodes, places, scales, threshold)
                            : sound((const float*)values, nodes, places, scales, threshold);
}

}  // extern "C"
