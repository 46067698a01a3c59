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

// Items 0 to count - 1 in runs of `run`; each goes to the next thread of a team that is free.
class Items {
 public:
  explicit Items(int64_t count, int64_t run = 1) : count_(count), run_(run) {}

  // Takes the next run, items [begin, end); false if none is left.
  bool take(int64_t& begin, int64_t& end) {
    if (trace != nullptr) trace->run();
    begin = next_.fetch_add(run_, std::memory_order_relaxed);
    end = std::min(begin + run_, count_);
    return begin < count_;
  }

 private:
  std::atomic<int64_t> next_{0};
  const int64_t count_, run_;
};

// body(item) for every item, on at most `threads` threads, no more than there are runs. What is thrown out of body, as
// where memory has run out, ends the loop and is thrown again to the caller.
template <typename Body>
void parallel_for(int64_t count, int64_t run, int threads, const Body& body) {
  const int64_t runs = (count + run - 1) / run;
  Items items(count, run);
  std::atomic<bool> failed{false};
  std::exception_ptr failure;
  parallel(static_cast<int>(std::min<int64_t>(threads, runs)), [&](int) {
    try {
      for (int64_t begin, end; !failed.load(std::memory_order_relaxed) && items.take(begin, end);) {
        for (int64_t item = begin; item < end; ++item) body(item);
      }
    } catch (...) {
      if (!failed.exchange(true)) failure = std::current_exception();
    }
  });
  if (failure) std::rethrow_exception(failure);
}

}  // namespace voronerf
