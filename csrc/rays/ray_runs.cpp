// Both functions run on one thread: a step has only some thousands of samples and some hundreds of runs.
#include "rays/ray_runs.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "rays/render_loss_math.h"

namespace voronerf {

int64_t own_samples_cpu(const KnownSamples& in, const OwnSamples& out, int) {
  int64_t count = 0, runs = 0, before = -2;
  for (int64_t i = 0; i < in.n; ++i) {
    const int32_t cell = in.local_cells[in.cells[i]];
    if (cell < 0) continue;
    const int32_t ray = in.ray_index[i];
    bool begins = i - before != 1 || ray != out.ray_index[count - 1];
    if (!begins) {
      // If the two depths differ by less than the shorter delta, no stratum lies between the samples.
      const bool near = in.depths[i] - out.depths[count - 1] < std::min(in.deltas[i], out.deltas[count - 1]);
      begins = !near && (in.curved || cell != out.cells[count - 1]);
    }
    if (begins) out.offsets[runs++] = static_cast<int32_t>(count);
    for (int k = 0; k < 3; ++k) out.positions[3 * count + k] = in.positions[3 * i + k];
    out.ray_index[count] = ray;
    out.depths[count] = in.depths[i];
    out.deltas[count] = in.deltas[i];
    out.cells[count++] = cell;
    before = i;
  }
  out.offsets[runs] = static_cast<int32_t>(count);
  return runs;
}

float compose_runs_cpu(const RunsOfRays& in, float* answers, int) {
  std::vector<int64_t> ends(in.r + 1), order(in.q);
  const auto ray_of = [&](int64_t run) { return static_cast<int64_t>(in.sums[6 * run + 5]) - in.first; };
  const double least = static_cast<double>(in.first), beyond = static_cast<double>(in.first + in.r);
  for (int64_t run = 0; run < in.q; ++run) {
    const double number = in.sums[6 * run + 5];
    if (!(number >= least && number < beyond)) {  // also rejects NaN, which must not be converted
      char text[32];
      std::snprintf(text, sizeof(text), "%g", number);
      throw std::invalid_argument("compose_runs: rays must be " + std::to_string(in.first) + " to " +
                                  std::to_string(in.first + in.r - 1) + ", got " + text);
    }
    ++ends[ray_of(run)];
  }
  for (int64_t ray = 0, sum = 0; ray <= in.r; ++ray) sum += std::exchange(ends[ray], sum);
  // `ends` holds the start of each ray's runs in `order`; this loop advances it to their end.
  for (int64_t run = 0; run < in.q; ++run) order[ends[ray_of(run)]++] = run;
  const float share = 2.0f / (3.0f * static_cast<float>(in.rays));
  double loss = 0.0;
  for (int64_t ray = 0, begin = 0; ray < in.r; begin = ends[ray++]) {
    const auto start = [&](int64_t run) { return in.sums[6 * run + 4]; };
    std::stable_sort(order.begin() + begin, order.begin() + ends[ray],
                     [&](int64_t a, int64_t b) { return start(a) < start(b); });
    const float* background = in.background;
    if (background != nullptr && in.background_per_ray) background += 3 * ray;
    double front = 0.0, light[3] = {}, slopes[3], behind = 0.0;
    for (int64_t i = begin; i < ends[ray]; ++i) {
      const float* sum = in.sums + 6 * order[i];
      float* answer = answers + 6 * order[i];
      answer[4] = static_cast<float>(front);
      for (int k = 0; k < 3; ++k) light[k] += std::exp(-front) * static_cast<double>(sum[k]);
      front += static_cast<double>(sum[3]);
    }
    double left[3] = {};
    float off[3], error = 0.0f;
    for (int k = 0; k < 3; ++k) {
      if (background != nullptr) left[k] = std::exp(-front) * static_cast<double>(background[k]);
      off[k] = static_cast<float>(light[k] + left[k]) - in.target[3 * ray + k];
      error += off[k] * off[k];
    }
    for (int k = 0; k < 3; ++k) {
      slopes[k] = static_cast<double>(off[k] * (share * ray_loss_slope(error, in.robust)));
      behind += slopes[k] * left[k];
    }
    loss += static_cast<double>(ray_loss(error, in.robust));
    for (int64_t i = ends[ray]; i-- > begin;) {
      const float* sum = in.sums + 6 * order[i];
      float* answer = answers + 6 * order[i];
      for (int k = 0; k < 3; ++k) answer[k] = static_cast<float>(slopes[k]);
      answer[3] = static_cast<float>(behind);
      answer[5] = error;
      const double arrives = std::exp(-static_cast<double>(answer[4]));
      for (int k = 0; k < 3; ++k) behind += slopes[k] * arrives * static_cast<double>(sum[k]);
    }
  }
  return static_cast<float>(loss / (3.0 * static_cast<double>(in.rays)));
}

}  // namespace voronerf
