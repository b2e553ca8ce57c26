// SPDX-License-Identifier: MIT
// The threads that work on a step: one team for the process. Its helpers wait for work with their eyes open for SPIN_SECONDS and
// then sleep, so that neither the many short loops of a solve pay for waking them nor a paused simulation for their waiting. Who calls
// takes a part of the work itself. Where the team has work already (another simulation of the process, or a loop within a loop) the
// caller does all of it: what is computed never depends on how many threads there are.
#pragma once
#include <pthread.h>
#include <sched.h>
#include <signal.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <system_error>
#include <thread>

constexpr double SPIN_SECONDS = 1e-4;
constexpr int MOST_THREADS = 1024;
constexpr int PATIENT_LOOKS = 4096;  // at a flag of another thread before its core is offered to others

static inline void relax() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

// Waits until ready() for something that another thread is at work on.
template <class F> static inline void wait_for(F ready) {
    for (int looks = 0; !ready(); ++looks) {
        if (looks < PATIENT_LOOKS) relax();
        else sched_yield();
    }
}

class Team {
public:
    // f(k, parts) for k in [0, parts), each on a thread of its own at the same time, k = 0 on the caller's. Without so many threads
    // f(0, 1) alone.
    template <class F> static void run(int parts, F f) {
        Team* team = parts > 1 && !inside() ? of_process() : nullptr;
        if (!team || !team->take(parts)) return f(0, 1);
        team->work(parts, [](void* data, int k, int parts) { (*static_cast<F*>(data))(k, parts); }, &f);
    }
    // f(i) for i in [0, count) in any order, on so many threads at most; who is done takes the next one.
    template <class F> static void each(int threads, int count, F f) {
        std::atomic<int> next{0};
        run(std::min(threads, count), [&](int, int) {
            for (int i; (i = next.fetch_add(1, std::memory_order_relaxed)) < count;) f(i);
        });
    }
    // True on a thread that is at work for the team, where nothing is shared out any more.
    static bool& inside() {
        static thread_local bool is = false;
        return is;
    }

private:
    using Call = void (*)(void*, int, int);
    static constexpr int PARTS_BITS = 16;

    alignas(64) std::atomic<uint64_t> order{0};  // number of the job and, in its low bits, how many parts it has
    alignas(64) std::atomic<int> left{0};        // parts of helpers that are not done
    alignas(64) std::atomic<int> sleepers{0};
    Call call = nullptr;
    void* data = nullptr;
    std::mutex busy, sleep;
    std::condition_variable woken;
    int members = 1;  // threads there are, with the caller

    // The team is never deleted: its helpers may sleep until the process ends. After a fork the child has none of them.
    static std::atomic<Team*>& place() {
        static std::atomic<Team*> team{nullptr};
        return team;
    }
    static Team* of_process() {
        if (Team* team = place().load(std::memory_order_acquire)) return team;
        static std::mutex making;
        std::lock_guard<std::mutex> lock(making);
        if (Team* team = place().load(std::memory_order_acquire)) return team;
        static const int registered = pthread_atfork(nullptr, nullptr, [] { place().store(nullptr); });
        (void)registered;
        Team* team = new Team;
        place().store(team, std::memory_order_release);
        return team;
    }

    // Makes the team the caller's, if it is free and has so many threads or can get them.
    bool take(int parts) {
        if (!busy.try_lock()) return false;
        if (members < std::min(parts, MOST_THREADS)) grow(std::min(parts, MOST_THREADS));
        if (members >= parts) return true;
        busy.unlock();
        return false;
    }
    // Helpers take no signals, which are the main thread's.
    void grow(int wanted) {
        sigset_t all, before;
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);
        try {
            for (; members < wanted; ++members) {
                std::thread helper([this, k = members, seen = order.load()] { help(k, seen); });
                pthread_setname_np(helper.native_handle(), "step");
                helper.detach();
            }
        } catch (const std::system_error&) {  // no more threads are allowed: the caller does it alone
        }
        pthread_sigmask(SIG_SETMASK, &before, nullptr);
    }

    void work(int parts, Call f, void* with) {
        call = f;
        data = with;
        left.store(parts - 1, std::memory_order_relaxed);
        order.store((((order.load(std::memory_order_relaxed) >> PARTS_BITS) + 1) << PARTS_BITS) + parts);
        if (sleepers.load() > 0) {
            { std::lock_guard<std::mutex> lock(sleep); }
            woken.notify_all();
        }
        inside() = true;
        f(with, 0, parts);
        inside() = false;
        wait_for([&] { return left.load(std::memory_order_acquire) == 0; });
        busy.unlock();
    }

    void help(int k, uint64_t seen) {
        inside() = true;
        for (;;) {
            seen = next(seen);
            const int parts = (int)(seen & ((1 << PARTS_BITS) - 1));
            if (k >= parts) continue;  // without looking at what may be changed already
            call(data, k, parts);
            left.fetch_sub(1, std::memory_order_release);
        }
    }
    // The order after `seen`.
    uint64_t next(uint64_t seen) {
        using clock = std::chrono::steady_clock;
        const auto until = clock::now() + std::chrono::duration_cast<clock::duration>(std::chrono::duration<double>(SPIN_SECONDS));
        do {
            for (int looks = 0; looks < 64; ++looks, relax())
                if (const uint64_t now = order.load(std::memory_order_acquire); now != seen) return now;
        } while (clock::now() < until);
        std::unique_lock<std::mutex> lock(sleep);
        sleepers.fetch_add(1);
        woken.wait(lock, [&] { return order.load() != seen; });
        sleepers.fetch_sub(1);
        return order.load();
    }
};
