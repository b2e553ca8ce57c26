// SPDX-License-Identifier: MIT
// Encodes rows of columns as protobuf messages (protobuf.dev/programming-guides/encoding): many small ones, each of which takes
// Python's library as long as a thousand of them do here.
#include <cmath>
#include <cstdint>
#include <cstring>

#include "../backends/cpu/native/sizes.h"

struct Column {
    const char* first;  // value of the first row
    int64_t stride;     // bytes from one row to the next
    int32_t tag;        // number of the field << 3 | wire type: 0 of an integer, 1 of a float64
    int32_t bytes;      // of a value: 4 or 8
    int32_t optional;   // 1: NaN is left out, 0 is not; 0: what is 0 is left out
    int32_t unused;
};

static char* put_varint(char* to, uint64_t value) {
    for (; value >= 0x80; value >>= 7) *to++ = (char)(value | 0x80);
    *to++ = (char)value;
    return to;
}

static char* put_value(char* to, const Column& column, const char* from) {
    if ((column.tag & 7) == 1) {
        uint64_t bits;
        double value;
        std::memcpy(&bits, from, sizeof bits);
        std::memcpy(&value, from, sizeof value);
        if (column.optional ? std::isnan(value) : bits == 0) return to;
        to = put_varint(to, (uint32_t)column.tag);
        std::memcpy(to, &bits, sizeof bits);  // little-endian, as the processors that this runs on
        return to + sizeof bits;
    }
    int64_t value = 0;
    int32_t narrow;
    if (column.bytes == 4) {
        std::memcpy(&narrow, from, sizeof narrow);
        value = narrow;  // negative ones have the sign in all ten bytes
    } else {
        std::memcpy(&value, from, sizeof value);
    }
    return value ? put_varint(put_varint(to, (uint32_t)column.tag), (uint64_t)value) : to;
}

extern "C" {

// Row i becomes prefix[number[i]] and its columns. out: room for all prefixes, and 15 bytes for each value. ends: (rows,) of the
// messages in it. prefix_ends: of the prefixes, one after another.
void wf_encode(const Column* columns, int32_t count, int64_t rows, const char* prefixes, const int64_t* prefix_ends, const int64_t* number,
               char* out, int64_t* ends) {
    char* to = out;
    for (int64_t i = 0; i < rows; ++i) {
        const int64_t begin = number[i] ? prefix_ends[number[i] - 1] : 0, size = prefix_ends[number[i]] - begin;
        std::memcpy(to, prefixes + begin, size);
        to += size;
        for (int32_t k = 0; k < count; ++k) to = put_value(to, columns[k], columns[k].first + i * columns[k].stride);
        ends[i] = to - out;
    }
}

const StructSize* wf_sizes() {
    static const StructSize sizes[] = {SIZE(Column), {}};
    return sizes;
}
}
