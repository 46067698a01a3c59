// Teams of threads. The kernels distribute their work by `parallel` and `Items` instead of OpenMP loops, so that one
// macro, VN_STD_THREADS, runs them on std::thread. ThreadSanitizer does not know libgomp's barriers and would report
// every result of a region as a race (tests/cpp/sanitize.sh). The body of a region is the same in both builds.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>

#ifdef VN_STD_THREADS
#include <thread>
#include <vector>
#elif defined(_OPENMP)
#include <omp.h>
#endif

#include "common/team.h"

namespace voronerf {

// Calls body(thread) once on each thread of a team of at most `threads`, numbered from 0, and returns when all calls
// have returned. With one thread there is no team: the calling thread runs the body. A forked child must use one
// thread. The body must not throw.
template <typename Body>
void parallel(int threads, const Body& body) {
  if (threads <= 1) return body(0);
  if (Team::current() != nullptr) return Team::current()->run(threads, body);
#ifdef VN_STD_THREADS
  std::vector<std::thread> others;
  for (int thread = 1; thread < threads; ++thread) others.emplace_back([&body, thread] { body(thread); });
  body(0);
  for (std::thread& other : others) other.join();
#elif defined(_OPENMP)
#pragma omp parallel num_threads(threads)
  body(omp_get_thread_num());
#else
  body(0);
#endif
}

// Calls body() on the calling thread. Up to `threads` - 1 other threads join the calling thread in the parallel regions
// of the body, and wait between regions, so that one team serves all regions.
template <typename Body>
void with_team(int threads, const Body& body) {
  if (threads <= 1) return body();
  Team team;
  parallel(threads, [&](int thread) { thread == 0 ? team.lead(body) : team.follow(); });
}

// Distributes items 0 to count - 1 among the threads of a team, in runs of `run` neighbouring items. Every thread has a
// contiguous part of the items and takes its runs in order; then it steals runs from the other parts. So a thread takes
// mostly the same items in every call, and its cache still holds the results of the previous call.
class Items {
 public:
  Items(int64_t count, int64_t run, int threads) : run_(run) {
    const int64_t runs = (count + run - 1) / run;
    parts_ = static_cast<int>(std::clamp<int64_t>(std::min<int64_t>(threads, runs), 1, kMost));
    for (int part = 0; part < parts_; ++part) {
      of_[part].next.store(runs * part / parts_ * run, std::memory_order_relaxed);
      of_[part].end = std::min(runs * (part + 1) / parts_ * run, count);
    }
  }

  // Takes the next run of a thread, items [begin, end). Returns false if no run is left.
  bool take(int thread, int64_t& begin, int64_t& end) {
    for (int i = 0; i < parts_; ++i) {
      Part& part = of_[(thread + i) % parts_];
      if (part.next.load(std::memory_order_relaxed) >= part.end) continue;
      begin = part.next.fetch_add(run_, std::memory_order_relaxed);
      end = std::min(begin + run_, part.end);
      if (begin < end) return true;
    }
    return false;
  }

 private:
  static constexpr int kMost = 64;
  struct alignas(64) Part {
    std::atomic<int64_t> next;
    int64_t end;
  };
  Part of_[kMost];
  int parts_;
  const int64_t run_;
};

// Calls body(item) for the items of a run. This is not inlined: inside parallel_for, the body's loops would
// share registers with the distribution of the items, and cell_sort would take 1.5 times as long.
template <typename Body>
__attribute__((noinline)) void run_items(const Body& body, int64_t begin, int64_t end) {
  for (int64_t item = begin; item < end; ++item) body(item);
}

// Calls body(item) for every item, on at most `threads` threads and at most one per run. An exception of the body, such
// as std::bad_alloc, ends the loop and is rethrown to the caller.
template <typename Body>
void parallel_for(int64_t count, int64_t run, int threads, const Body& body) {
  const int64_t runs = (count + run - 1) / run;
  Items items(count, run, static_cast<int>(std::min<int64_t>(threads, runs)));
  std::atomic<bool> failed{false};
  std::exception_ptr failure;
  parallel(static_cast<int>(std::min<int64_t>(threads, runs)), [&](int thread) {
    try {
      for (int64_t begin, end; !failed.load(std::memory_order_relaxed) && items.take(thread, begin, end);) {
        run_items(body, begin, end);
      }
    } catch (...) {
      if (!failed.exchange(true)) failure = std::current_exception();
    }
  });
  if (failure) std::rethrow_exception(failure);
}

// Calls body(begin, end) for blocks of `block` items.
template <typename Body>
void parallel_blocks(int64_t count, int64_t block, int threads, const Body& body) {
  parallel_for((count + block - 1) / block, 1, threads,
               [&](int64_t i) { body(i * block, std::min(count, (i + 1) * block)); });
}

}  // namespace voronerf
