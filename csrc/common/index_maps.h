// Index maps and searches of the CUDA kernels, as plain functions. tests/cuda_emulation/test_index_maps.py goes through
// all of their arguments and compares with brute force: every element is visited once and none is out of range. Lanes
// are unsigned, because a signed number cannot be divided by a shift alone.
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace voronerf {

struct MapPlace {
  int row, column;
};

// Returns the row and column of a lane's accumulator i (0..3) in a tile [16][8] of mma.sync.
VN_HD constexpr MapPlace accumulator_place(unsigned lane, int i) {
  return {static_cast<int>(lane / 4) + 8 * (i / 2), static_cast<int>(2 * (lane % 4)) + i % 2};
}

// The order of the columns of an encoding by octaves as 16-bit numbers. In a program, the columns are the features if
// `raw`, and for each octave the sines of all features and then their cosines. Here the features come last, and a sine
// and its cosine are one word. Four octaves (at the end two, then one) of a feature are neighbours, so that a thread
// stores them at once.
struct WaveOrder {
  int octaves, features, raw;
};
// Returns the number of octaves that are stored together with an octave: 4, 2 or 1, which is a shift by 2, 1 or 0. A
// division takes 20 instructions.
VN_HD constexpr int wave_group(const WaveOrder& order, int octave) {
  return octave < (order.octaves & ~3) ? 4 : octave < (order.octaves & ~1) ? 2 : 1;
}
// `wave_place` returns the place of a program's column, `wave_column` the column at a place.
VN_HD constexpr int wave_place(const WaveOrder& order, int column) {
  const int wave = column - order.raw * order.features, feature = wave % order.features;
  if (wave < 0) return 2 * order.octaves * order.features + column;
  const int row = wave / order.features, octave = row / 2, group = wave_group(order, octave),
            first = octave & ~(group - 1);
  return 2 * (first * order.features + group * feature + octave - first) + row % 2;
}
VN_HD constexpr int wave_column(const WaveOrder& order, int place) {
  const int raw = place - 2 * order.octaves * order.features;
  if (raw >= 0) return raw;
  const int word = place / 2, octave = word / order.features, group = wave_group(order, octave),
            first = octave & ~(group - 1), within = word - first * order.features;
  return (order.raw + 2 * (first + (within & (group - 1))) + place % 2) * order.features + (within >> group / 2);
}

// The range in which a warp searches non-decreasing values for the last value that is at most a bound. `probed` returns
// the index that a lane probes, `narrowed` the range that remains if `votes` probes are at most the bound. The first
// value must be at most the bound.
struct MapSpan {
  int64_t first, last;
};
VN_HD constexpr int64_t probed(const MapSpan& span, int64_t lane) {
  return span.first + lane * ((span.last - span.first + 31) / 32);
}
VN_HD constexpr MapSpan narrowed(const MapSpan& span, int votes) {
  const int64_t first = probed(span, votes == 0 ? 0 : votes - 1), last = probed(span, votes == 0 ? 1 : votes);
  return {first, last < span.last ? last : span.last};
}

// Returns the index of the first of n non-decreasing values that is above `value`; n if none is.
template <typename T>
VN_HD constexpr int64_t first_above(const T* values, int64_t n, int64_t value) {
  int64_t low = 0, high = n;
  while (low < high) {
    const int64_t middle = low + (high - low) / 2;
    if (static_cast<int64_t>(values[middle]) <= value) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

// Returns the bucket of a cell: 0 for cells below 0, cell + 1 for the k valid cells, k + 1 for cells from k on.
VN_HD constexpr int64_t bucket_of_cell(int32_t cell, int64_t k) {
  return cell < 0 ? 0 : cell >= k ? k + 1 : static_cast<int64_t>(cell) + 1;
}

}  // namespace voronerf
