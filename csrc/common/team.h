// Threads that wait for the regions of one of them, its leader (common/parallel.h): a recording is replayed by a team.
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
  // Of the calling thread, while it leads one and is in no region; else null.
  static Team*& current() {
    static thread_local Team* team = nullptr;
    return team;
  }

  // body() as the leader, and the end of the team. Nothing may be thrown out of body.
  template <typename Body>
  void lead(const Body& body) {
    current() = this;
    body();
    current() = nullptr;
    post(kEnd);
  }

  // What every other thread does: regions, until the team ends. Who comes late takes part from the next region on.
  void follow() {
    uint64_t seen = job_.load();
    const uint64_t own = followers_.fetch_add(1) + 1;
    while (seen != kEnd) {
      wait([&] { return job_.load() != seen; });
      seen = job_.load();
      if (seen == kEnd || seen % kMost < own) continue;  // a region of fewer threads, or from before this one came
      call_(body_, static_cast<int>(own));
      if (working_.fetch_sub(1) == 1) wake();
    }
  }

  // body(thread) once for each thread of the leader and at most `threads` - 1 of those that are there.
  template <typename Body>
  void run(int threads, const Body& body) {
    const uint64_t others = std::min({static_cast<uint64_t>(threads) - 1, followers_.load(), kMost - 1});
    Team* const own = std::exchange(current(), nullptr);  // regions of body are run by one thread
    if (others != 0) {
      body_ = &body;
      call_ = [](const void* of, int thread) { (*static_cast<const Body*>(of))(thread); };
      working_.store(others);
      post((job_.load() / kMost + 1) * kMost + others);
    }
    body(0);
    if (others != 0) wait([&] { return working_.load() == 0; });
    current() = own;
  }

 private:
  static constexpr uint64_t kMost = 1024, kEnd = ~uint64_t{0};
  // A thread that waits looks again and again for about as long as it takes to sleep and to be woken, then it sleeps:
  // so it loses at most half of its time. In between it yields to whoever wants the core.
  static constexpr std::chrono::microseconds kLook{200};

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
    const auto until = std::chrono::steady_clock::now() + kLook;
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

  // The number of a region times kMost, and how many threads it has beside the leader.
  std::atomic<uint64_t> job_{0};
  std::atomic<uint64_t> followers_{0}, working_{0}, sleepers_{0};
  const void* body_ = nullptr;
  void (*call_)(const void*, int) = nullptr;
  std::mutex mutex_;
  std::condition_variable changed_;
};

}  // namespace voronerf
