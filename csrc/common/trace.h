// An estimate of the time of a call's parallel regions on more threads, from a trace on one thread. The time of each
// run of items is added to the thread that would be free first, as in Items. benchmarks/cores.py prints the estimates
// as a table.
#pragma once

#include <algorithm>
#include <ctime>
#include <vector>

namespace voronerf {

class Trace {
 public:
  static constexpr int kTeams[] = {2, 8, 16, 32};

  void begin() {
    for (int team = 0; team < 4; ++team) busy_[team].assign(kTeams[team], 0.0);
    ++regions;
    last_ = now();
  }
  // Ends a run, or begins the first one.
  void run() {
    const double time = now(), taken = time - last_;
    last_ = time;
    inside += taken;
    for (std::vector<double>& thread : busy_) *std::min_element(thread.begin(), thread.end()) += taken;
  }
  void end() {
    run();
    for (int team = 0; team < 4; ++team) shared[team] += *std::max_element(busy_[team].begin(), busy_[team].end());
  }
  // Returns the processor time in seconds, which does not depend on other processes.
  static double now() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

  int regions = 0;
  double inside = 0.0;    // seconds in regions
  double shared[4] = {};  // estimated seconds of the regions on kTeams threads

 private:
  std::vector<double> busy_[4];
  double last_ = 0.0;
};

// The trace of the calling thread; null unless its call is being traced.
inline thread_local Trace* trace = nullptr;

}  // namespace voronerf
