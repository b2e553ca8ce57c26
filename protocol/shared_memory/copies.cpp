// SPDX-License-Identifier: MIT
// Copies many arrays, sums them up and looks at their numbers, in one call without Python's lock (copies.py).

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>
#include <exception>
#include <thread>
#include <vector>

namespace {

constexpr int64_t PIECE = 16 << 10;  // bytes that are looked at while they are in the nearest cache

// True unless an exponent has all bits set: NaN or infinity.
template <class Bits, Bits EXPONENT>
bool all_finite(const char* data, int64_t bytes) {
    typedef Bits Word __attribute__((may_alias));
    const Word* words = reinterpret_cast<const Word*>(data);
    Bits found = 0;
    for (int64_t i = 0; i < bytes / int64_t(sizeof(Bits)); i++) found |= Bits((words[i] & EXPONENT) == EXPONENT);
    return !found;
}

bool all_finite(const char* data, int64_t bytes, int32_t item) {
    return item == 8 ? all_finite<uint64_t, 0x7ff0000000000000u>(data, bytes) : all_finite<uint32_t, 0x7f800000u>(data, bytes);
}

template <class Number>
bool all_positive(const char* data, const int64_t* places, int64_t count) {
    typedef Number Aliased __attribute__((may_alias));
    const Aliased* numbers = reinterpret_cast<const Aliased*>(data);
    bool found = true;
    for (int64_t i = 0; i < count; i++) found &= numbers[places[i]] > 0;
    return found;
}

}  // namespace

extern "C" {

// Copies sources[i] to targets[i], of bytes[i] each; of the copies, or of what is summed up in place without targets, sums[i] is
// the hash, and finite[i] whether all numbers of `item` bytes, 4 or 8, are finite (null: not looked at). own_sources: that is
// said of the sources.
// places: null, or of each the numbers, place_count[i] of them, of which positive[i] tells whether all are greater than 0.
// threads: that share the work, this one among them, if there are so many.
void copy_all(int64_t count, const char* const* sources, char* const* targets, const int64_t* bytes, int32_t item,
              int32_t own_sources, uint64_t (*hash)(const void*, size_t), uint64_t* sums, uint8_t* finite,
              const int64_t* const* places, const int64_t* place_count, uint8_t* positive, int32_t threads) {
    std::atomic<int64_t> next{0};
    auto work = [&] {
        for (int64_t i = next++; i < count; i = next++) {
            const char* own = own_sources || !targets ? sources[i] : targets[i];
            bool good = true;
            for (int64_t at = 0; at < bytes[i]; at += PIECE) {
                const int64_t size = std::min(PIECE, bytes[i] - at);
                if (targets) std::memcpy(targets[i] + at, sources[i] + at, size_t(size));
                if (finite) good &= all_finite(own + at, size, item);
            }
            if (finite) finite[i] = good;
            sums[i] = hash(own, size_t(bytes[i]));
            if (places)
                positive[i] = item == 8 ? all_positive<double>(own, places[i], place_count[i])
                                        : all_positive<float>(own, places[i], place_count[i]);
        }
    };
    std::vector<std::thread> others;
    try {
        for (int32_t k = 1; k < threads; k++) others.emplace_back(work);
    } catch (const std::exception&) {  // the system gives no more of them, or no memory: those that there are do it
    }
    work();
    for (std::thread& each : others) each.join();
}

}  // extern "C"
