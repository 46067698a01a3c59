// What the regions of a call would take on more threads, found on one: the time that each run of items takes is given
// to the thread that would be free first, as Items does it. benchmarks/cores.py makes its table of that.
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
  // A run has ended, or the first one begins.
  void run() {
    const double time = now(), taken = time - last_;
    last_ = time;
    inside += taken;
    for (std::vector<double>& each : busy_) *std::min_element(each.begin(), each.end()) += taken;
  }
  void end() {
    run();
    for (int team = 0; team < 4; ++team) shared[team] += *std::max_element(busy_[team].begin(), busy_[team].end());
  }
  // Processor time, which other processes on the machine do not stretch.
  static double now() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

  int regions = 0;
  double inside = 0.0;    // seconds in regions
  double shared[4] = {};  // what these would take on kTeams threads

 private:
  std::vector<double> busy_[4];
  double last_ = 0.0;
};

// Of the calling thread; null but for a call that is traced on one thread.
inline thread_local Trace* trace = nullptr;

}  // namespace voronerf
