// SPDX-License-Identifier: MIT
// Judges factors before they are used: those that came, and those of a message while they are copied out of shared memory. No loop calls
// this.
#include <algorithm>
#include <atomic>
#include <cstring>
#include <exception>
#include <thread>
#include <vector>

#include "factor_judge.h"
#include "sizes.h"

namespace {

constexpr int64_t PIECE = 16 << 10;  // bytes that are looked at while they are in the nearest cache

typedef uint64_t (*Hash)(const void*, size_t);
// As largest_responses of digits.cpp.
typedef void (*Responses)(int64_t, int64_t, const int32_t*, const int64_t*, const int32_t*, const int64_t*, const float* const*, double*,
                          int32_t);

// A factor of a message.
struct ArrivingFactor {
    const char* source;  // its values in shared memory, which others may write to
    char* target;        // where they are copied to: only that is looked at
    int64_t bytes;
    const Pattern* pattern;
    const int32_t *row_start, *columns;  // of A, as of wf_judge_all
    const double *matrix, *r;            // null: it is not judged
    int32_t nodes, item;                 // bytes of a value: 4 or 8
    // What is found:
    uint64_t checksum;
    int32_t finite, positive;  // all values, all on the diagonal
    double judged[5];          // as out of wf_judge_all
    double response;           // the largest, of a factor in float32
};

// True unless an exponent has all bits set: NaN or infinity.
template <class Bits, Bits EXPONENT>
bool all_finite(const char* data, int64_t bytes) {
    typedef Bits Word __attribute__((may_alias));
    const Word* words = reinterpret_cast<const Word*>(data);
    Bits found = 0;
    for (int64_t i = 0; i < bytes / int64_t(sizeof(Bits)); i++) found |= Bits((words[i] & EXPONENT) == EXPONENT);
    return !found;
}

template <class T>
bool all_positive(const Pattern& p, const char* data) {
    bool found = true;
    for (int s = 0; s < p.supernodes; ++s) {
        const int columns = p.super_start[s + 1] - p.super_start[s];
        const Panel<T> L{(const T*)data + p.value_start[s], columns, (int)(p.row_start[s + 1] - p.row_start[s])};
        for (int k = 0; k < columns; ++k) found &= L.column(k)[k] > 0;
    }
    return found;
}

void copy(ArrivingFactor& f, Hash hash) {
    bool finite = true;
    for (int64_t at = 0; at < f.bytes; at += PIECE) {
        const int64_t size = std::min(PIECE, f.bytes - at);
        char* own = f.target + at;
        std::memcpy(own, f.source + at, size_t(size));
        finite &= f.item == 8 ? all_finite<uint64_t, 0x7ff0000000000000u>(own, size) : all_finite<uint32_t, 0x7f800000u>(own, size);
    }
    f.finite = finite;
    if (hash) f.checksum = hash(f.target, size_t(f.bytes));
    f.positive = f.item == 8 ? all_positive<double>(*f.pattern, f.target) : all_positive<float>(*f.pattern, f.target);
}

void estimate(ArrivingFactor& f, Responses responses) {
    const Pattern& p = *f.pattern;
    const float* values = (const float*)f.target;
    responses(1, p.supernodes, p.super_start, p.row_start, p.rows, p.value_start, &values, &f.response, 1);
}

// Columns of factors that are judged once they are copied.
struct Columns {
    std::vector<Factor> factors;
    std::vector<int32_t> nodes;
    std::vector<const int32_t*> row_start, columns;
    std::vector<const double*> values, r, applied;
    std::vector<double> out;

    Columns(const ArrivingFactor* each, int32_t count) : applied(count), out(5 * count) {
        for (int32_t k = 0; k < count; ++k) {
            const ArrivingFactor& f = each[k];
            factors.push_back({f.pattern, f.target, 0, f.item});
            nodes.push_back(f.nodes);
            row_start.push_back(f.row_start), columns.push_back(f.columns);
            values.push_back(f.matrix), r.push_back(f.r);
        }
    }
    Given given(int32_t parts) {
        return {(int32_t)factors.size(), parts, factors.data(), nodes.data(), row_start.data(), columns.data(), values.data(), r.data(),
                applied.data(), out.data()};
    }
};

// Calls work(first, some, memory) of each group of factors that are judged together; `threads` share the groups, this one among them,
// each with `room` entries of memory.
template <class Work>
void share(const Given& given, double* memory, int64_t room, int32_t threads, Work work) {
    std::vector<std::pair<int, int>> groups;
    for (int i = 0, some; i < given.count; i += some) groups.emplace_back(i, some = given.together(i));
    std::atomic<size_t> next{0};
    auto do_next = [&](double* own) {
        for (size_t k = next++; k < groups.size(); k = next++) work(groups[k].first, groups[k].second, own);
    };
    std::vector<std::thread> others;
    try {
        for (int32_t k = 1; k < threads; k++) others.emplace_back(do_next, memory + k * room);
    } catch (const std::exception&) {  // the system gives no more of them, or no memory: those that there are do it
    }
    do_next(memory);
    for (std::thread& each : others) each.join();
}

}  // namespace

extern "C" {

// Judges `count` factors; entry i of each array is of factor i. parts: of Part. nodes, row_start, columns, values: A, its nodes
// numbered from 0; values null: unknown. r: probe vector. applied: z, where the factor has been applied already: its values may be
// null then. work: `room` entries for each thread, for the largest of the factors 9 for each degree of freedom. out (count, 5): z.r and
// z.Az with the factor, then both with block Jacobi, and |r - Az| / |r| with the factor; without A only the first is written.
// threads: that share the factors, this one among them, if there are so many.
void wf_judge_all(int32_t count, int32_t parts, const Factor* factors, const int32_t* nodes, const int32_t* const* row_start,
                  const int32_t* const* columns, const double* const* values, const double* const* r, const double* const* applied,
                  double* work, double* out, int64_t room, int32_t threads) {
    const Given given = {count, parts, factors, nodes, row_start, columns, values, r, applied, out};
    share(given, work, room, threads, [&](int first, int some, double* own) { given.judge_some(first, some, own); });
}

// Copies factors out of shared memory, and finds what they show: those that were sent with A, whose `matrix` all have or none has,
// are judged in all parts. hash: of bytes; null: it is not asked for. responses: likewise. work, room, threads: as of wf_judge_all.
void wf_take_in(ArrivingFactor* each, int32_t count, Hash hash, Responses responses, double* work, int64_t room, int32_t threads) {
    Columns columns(each, count);
    const Given given = columns.given(WITH_FACTOR | WITH_BLOCK_JACOBI);
    share(given, work, room, threads, [&](int first, int some, double* own) {
        for (int k = first; k < first + some; ++k) copy(each[k], hash);
        if (each[first].matrix) given.judge_some(first, some, own);
        for (int k = first; k < first + some; ++k) {
            std::copy_n(&columns.out[5 * k], 5, each[k].judged);
            if (responses && each[k].item == 4) estimate(each[k], responses);
        }
    });
}

const StructSize* wf_sizes() {
    static const StructSize sizes[] = {SIZE(Factor), SIZE(Pattern), SIZE(ArrivingFactor), {}};
    return sizes;
}
}
