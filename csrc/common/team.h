// A team of threads that run the parallel regions of their leader (common/parallel.h). The replay of a recorded step
// (bindings/bind.cpp) runs all of its regions on one team.
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <thread>
#include <utility>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace voronerf {

class Team {
 public:
  // Returns the team that the calling thread leads; null inside a region, or if it leads no team.
  static Team*& current() {
    static thread_local Team* team = nullptr;
    return team;
  }

  // Runs body() as the leader, then ends the team. The body must not throw.
  template <typename Body>
  void lead(const Body& body) {
    current() = this;
    body();
    current() = nullptr;
    post(kEnd);
  }

  // Runs regions as a follower until the team ends. A thread that joins late takes part from the next region on.
  void follow() {
    uint64_t seen = job_.load();
    const uint64_t thread = followers_.fetch_add(1) + 1;
    while (seen != kEnd) {
      wait([&] { return job_.load() != seen; });
      seen = job_.load();
      if (seen == kEnd || seen % kMost < thread) continue;  // this thread has no part in the region, or joined too late
      call_(body_, static_cast<int>(thread));
      if (working_.fetch_sub(1) == 1) wake();
    }
  }

  // Runs a region: body(thread) once on the leader and on at most `threads` - 1 of the followers present.
  template <typename Body>
  void run(int threads, const Body& body) {
    const uint64_t others = std::min({static_cast<uint64_t>(threads) - 1, followers_.load(), kMost - 1});
    Team* const team = std::exchange(current(), nullptr);  // nested regions run on one thread
    if (others != 0) {
      body_ = &body;
      call_ = [](const void* of, int thread) { (*static_cast<const Body*>(of))(thread); };
      working_.store(others);
      post((job_.load() / kMost + 1) * kMost + others);
    }
    body(0);
    if (others != 0) wait([&] { return working_.load() == 0; });
    current() = team;
  }

 private:
  static constexpr uint64_t kMost = 1024, kEnd = ~uint64_t{0};
  // A waiting thread spins for about as long as falling asleep and waking would take, and then sleeps, so it loses at
  // most half of its time. While it spins, it yields its core to other threads.
  static constexpr std::chrono::microseconds kSpin{200};

  void post(uint64_t job) {
    job_.store(job);
    wake();
  }
  void wake() {
    if (sleepers_.load() == 0) return;
    const std::lock_guard<std::mutex> lock(mutex_);
    changed_.notify_all();
  }
  template <typename Done>
  void wait(const Done& done) {
    const auto until = std::chrono::steady_clock::now() + kSpin;
    do {
      for (int i = 0; i < 32; ++i) {
        if (done()) return;
#if defined(__x86_64__)
        _mm_pause();
#endif
      }
      std::this_thread::yield();
    } while (std::chrono::steady_clock::now() < until);
    std::unique_lock<std::mutex> lock(mutex_);
    sleepers_.fetch_add(1);
    changed_.wait(lock, done);
    sleepers_.fetch_sub(1);
  }

  // The number of the current region times kMost, plus its number of followers.
  std::atomic<uint64_t> job_{0};
  std::atomic<uint64_t> followers_{0}, working_{0}, sleepers_{0};
  const void* body_ = nullptr;
  void (*call_)(const void*, int) = nullptr;
  std::mutex mutex_;
  std::condition_variable changed_;
};

}  // namespace voronerf
