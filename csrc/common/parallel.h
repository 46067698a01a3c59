// Teams of threads. The kernels share their work out through `parallel` and `Items` rather than through loops of
// OpenMP, so that one macro, VN_STD_THREADS, runs all of it on std::thread: ThreadSanitizer knows nothing of libgomp's
// barriers and would report every result of a region as a race (tests/cpp/sanitize.sh). What a region does with its
// data is the same in both builds.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>

#include "common/trace.h"

#ifdef VN_STD_THREADS
#include <thread>
#include <vector>
#elif defined(_OPENMP)
#include <omp.h>
#endif

#include "common/team.h"

namespace voronerf {

// body(thread) once for each thread of a team of at most `threads`, numbered from 0; returns when all have. One thread
// is the caller's own, with no team, which is what a forked child can run. Nothing may be thrown out of body.
template <typename Body>
void parallel(int threads, const Body& body) {
  if (threads <= 1) {
    if (trace != nullptr) trace->begin();
    body(0);
    if (trace != nullptr) trace->end();
    return;
  }
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

// body() on the calling thread, beside up to `threads` - 1 others that run its regions and wait for the next of them
// without ending: what would be many teams, each woken anew, is one.
template <typename Body>
void with_team(int threads, const Body& body) {
  if (threads <= 1) return body();
  Team team;
  parallel(threads, [&](int thread) { thread == 0 ? team.lead(body) : team.follow(); });
}

// Items 0 to count - 1 in runs of `run`. Every thread of a team has a part of them, neighbours that it takes one after
// the other, and what is left of the others' when its own is done. So of the same items in call after call a thread
// takes much the same, and finds in its own cache what it wrote before.
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

  // Takes the next run of a thread, items [begin, end); false if none is left.
  bool take(int thread, int64_t& begin, int64_t& end) {
    if (trace != nullptr) trace->run();
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

// body(item) for every item, on at most `threads` threads, no more than there are runs. What is thrown out of body, as
// where memory has run out, ends the loop and is thrown again to the caller.
template <typename Body>
void parallel_for(int64_t count, int64_t run, int threads, const Body& body) {
  const int64_t runs = (count + run - 1) / run;
  Items items(count, run, static_cast<int>(std::min<int64_t>(threads, runs)));
  std::atomic<bool> failed{false};
  std::exception_ptr failure;
  parallel(static_cast<int>(std::min<int64_t>(threads, runs)), [&](int thread) {
    try {
      for (int64_t begin, end; !failed.load(std::memory_order_relaxed) && items.take(thread, begin, end);) {
        for (int64_t item = begin; item < end; ++item) body(item);
      }
    } catch (...) {
      if (!failed.exchange(true)) failure = std::current_exception();
    }
  });
  if (failure) std::rethrow_exception(failure);
}

// body(begin, end) for blocks of `block` items.
template <typename Body>
void parallel_blocks(int64_t count, int64_t block, int threads, const Body& body) {
  parallel_for((count + block - 1) / block, 1, threads,
               [&](int64_t i) { body(i * block, std::min(count, (i + 1) * block)); });
}

}  // namespace voronerf
