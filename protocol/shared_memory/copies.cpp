// SPDX-License-Identifier: MIT
// Copies many arrays and sums them up, in one call without Python's lock (copies.py).

#include <atomic>
#include <cstdint>
#include <cstring>
#include <exception>
#include <thread>
#include <vector>

extern "C" {

// Copies sources[i] to targets[i], of bytes[i] each; sums[i] is the hash of the copy, or of what is summed up in place without targets.
// own_sources: that is said of the source. threads: that share the work, this one among them, if there are so many.
void copy_all(int64_t count, const char* const* sources, char* const* targets, const int64_t* bytes, int32_t own_sources,
              uint64_t (*hash)(const void*, size_t), uint64_t* sums, int32_t threads) {
    std::atomic<int64_t> next{0};
    auto work = [&] {
        for (int64_t i = next++; i < count; i = next++) {
            if (targets) std::memcpy(targets[i], sources[i], size_t(bytes[i]));
            sums[i] = hash(own_sources || !targets ? sources[i] : targets[i], size_t(bytes[i]));
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
