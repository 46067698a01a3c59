// A sample is encoded as one 64-bit integer, its entry. The upper half holds the bits of the importance, which is not
// negative, so its bits sort like the number. The lower half holds the inverted bits of the sample's index. So no two
// entries are equal, larger entries are kept, and the kept samples do not depend on the order of comparisons. Each part
// of the samples collects entries above a common bound. When a part has 2 q entries, it drops the smaller half. The
// bound is raised to the smallest of the remaining q entries, because no smaller entry is among the q largest. Few
// samples are collected: about q (1 + ln(n / q)) of n samples in random order.
#include "rays/keep_heaviest.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <stdexcept>
#include <string>

#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr int64_t kParts = 8, kRun = 64;  // parts of a call; samples weighed at a time

uint64_t entry_of(float importance, int64_t i) {
  uint32_t bits;
  std::memcpy(&bits, &importance, sizeof bits);
  return static_cast<uint64_t>(bits) << 32 | ~static_cast<uint32_t>(i);
}

float importance_of(uint64_t entry) {
  const uint32_t bits = static_cast<uint32_t>(entry >> 32);
  float importance;
  std::memcpy(&importance, &bits, sizeof importance);
  return importance;
}

int64_t place_of(uint64_t entry) { return ~static_cast<uint32_t>(entry); }

// Computes the importances of samples [begin, end); returns whether all of their rays are in range.
bool weigh(const WeighedSamples& in, int64_t begin, int64_t end, float* importance) {
  if (in.error == nullptr) {
    std::copy(in.weights + begin, in.weights + end, importance);
    return true;
  }
  bool valid = true;
  for (int64_t i = begin; i < end; ++i) {
    const bool exists = in.ray_index[i] >= 0 && in.ray_index[i] < in.r;
    importance[i - begin] = exists ? in.weights[i] * in.error[in.ray_index[i]] : 0.0f;
    valid &= exists;
  }
  return valid;
}

// Collects the entries of samples [begin, end) that may be among the q heaviest, at most 2 q, in any order. Returns
// their number, or -1 if a ray is out of range. `least` is raised only to values that q entries reach.
int64_t find_heaviest(const WeighedSamples& in, int64_t begin, int64_t end, int64_t q, std::atomic<uint64_t>& least,
                      uint64_t* entries) {
  float importance[kRun];
  int64_t count = 0;
  for (int64_t first = begin; first < end; first += kRun) {
    const int64_t run = std::min(kRun, end - first);
    if (!weigh(in, first, first + run, importance)) return -1;
    uint64_t bound = least.load(std::memory_order_relaxed);
    const float lowest = importance_of(bound);
    bool has_candidate = false;
    for (int64_t i = 0; i < run; ++i) has_candidate |= importance[i] >= lowest;  // false for NaN
    if (!has_candidate) continue;
    for (int64_t i = 0; i < run; ++i) {
      if (!(importance[i] >= lowest) || importance[i] > std::numeric_limits<float>::max()) continue;
      const uint64_t entry = entry_of(importance[i], first + i);
      if (entry < bound) continue;
      entries[count++] = entry;
      if (count < 2 * q) continue;
      std::nth_element(entries, entries + q - 1, entries + count, std::greater<>());
      count = q;
      uint64_t current = least.load(std::memory_order_relaxed);
      while (current < entries[q - 1] &&
             !least.compare_exchange_weak(current, entries[q - 1], std::memory_order_relaxed)) {
      }
      bound = std::max(current, entries[q - 1]);
    }
  }
  return count;
}

}  // namespace

int64_t keep_heaviest_workspace(int64_t q) { return kParts * 2 * q; }

void keep_heaviest_cpu(const WeighedSamples& in, const KeptSamples& kept, int64_t* workspace, int threads) {
  auto* const entries = reinterpret_cast<uint64_t*>(workspace);
  int64_t counts[kParts], q = kept.q;
  std::atomic<uint64_t> least{entry_of(std::numeric_limits<float>::denorm_min(), in.m)};  // only positive importances
  parallel_for(kParts, 1, threads, [&](int64_t part) {
    counts[part] =
        find_heaviest(in, part * in.m / kParts, (part + 1) * in.m / kParts, q, least, entries + 2 * q * part);
  });
  int64_t count = 0;
  for (int64_t part = 0; part < kParts; ++part) {
    if (counts[part] < 0) {
      const auto [low, high] = std::minmax_element(in.ray_index, in.ray_index + in.m);
      throw std::invalid_argument("keep_heaviest: ray_index must lie in 0 to " + std::to_string(in.r - 1) +
                                  ", got values from " + std::to_string(*low) + " to " + std::to_string(*high));
    }
    std::copy_n(entries + 2 * q * part, counts[part], entries + count);
    count += counts[part];
  }
  const int64_t most = std::min(count, q);
  std::partial_sort(entries, entries + most, entries + count, std::greater<>());

  const int64_t slot = (*kept.added % kept.b + kept.b) % kept.b;
  float *const importance = kept.importance + slot * q, *const points = kept.points + slot * q * in.d;
  std::fill_n(importance, q, 0.0f);
  std::fill_n(points, q * in.d, 0.0f);
  for (int64_t i = 0; i < most; ++i) {
    const float* const point = in.points + place_of(entries[i]) * in.d;
    if (!std::all_of(point, point + in.d, [](float value) { return std::isfinite(value); })) continue;
    importance[i] = importance_of(entries[i]);
    std::copy_n(point, in.d, points + i * in.d);
  }
  ++*kept.added;
}

}  // namespace voronerf
