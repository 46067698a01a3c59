// Layers of up to four outputs, such as heads. The product of gemm_tile.h would leave most lanes of an output vector
// empty. Here vectors run along the inputs, and each output of a row is a dot product. A block has as many dot products
// as a vector has lanes, [rows][1] or [rows][4], and adds up the lanes of each at the end.
#pragma once

#include "network/cpu/gemm_tile.h"
#include "network/program_code.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// The depth of each source is a multiple of kLanes. Weights are [O][depth], where `depth` is the sum of the sources'
// depths, and C is [rows][kGranule], padded with 0. All sums use the same order, so a row's result does not depend on
// its position. If `rows` is not a multiple of a block's rows, the last row is computed repeatedly.
template <int O>
void few_outputs(const LeftPart* sources, int64_t count, const float* weights, int64_t depth, const float* bias,
                 bool relu, int64_t rows, float* c) {
  constexpr int kRows = kLanes / O;
  const F32 lowest = splat(relu ? 0.0f : -__builtin_huge_valf());  // NaN passes: it is not less
  float start[kLanes];
  for (int i = 0; i < kLanes; ++i) start[i] = bias[i % O];
  for (int64_t first = 0; first < rows; first += kRows) {
    int64_t row[kRows];
    F32 sum[kLanes];
    for (int r = 0; r < kRows; ++r) row[r] = first + r < rows ? first + r : rows - 1;
    for (int i = 0; i < kLanes; ++i) sum[i] = splat(0.0f);
    const float* w = weights;
    for (const LeftPart* source = sources; source != sources + count; w += source->depth, ++source) {
      for (int64_t k = 0; k < source->depth; k += kLanes) {
        F32 b[O];
        for (int o = 0; o < O; ++o) b[o] = load(w + o * depth + k);
        for (int r = 0; r < kRows; ++r) {
          const F32 a = load(source->data + row[r] * source->stride + k);
          for (int o = 0; o < O; ++o) sum[r * O + o] = multiply_add(a, b[o], sum[r * O + o]);
        }
      }
    }
    const F32 total = lane_sums(sum) + load(start);
    float result[kLanes];
    store(result, total < lowest ? lowest : total);
    for (int r = 0; r < kRows; ++r) {
      float* const to = c + row[r] * kGranule;
      for (int i = 0; i < kGranule; i += kLanes) store(to + i, splat(0.0f));
      __builtin_memcpy(to, result + r * O, O * sizeof(float));
    }
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
