// Layers of up to four outputs, as heads have: in the product of gemm_tile.h a vector of outputs would be empty but for
// those. Here vectors run along the inputs: each output of a row is a dot product, as many of which as a vector has
// lanes are summed at once, [rows][1] or [rows][4], and their lanes are added up together at the end.
#pragma once

#include "network/cpu/gemm_tile.h"
#include "network/program_code.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Sources in whole vectors of k; weights [O][all k]; C [rows][kGranule], filled up with 0. All sums are of the same
// shape, so a row's result does not depend on its place. The last rows are done again where `rows` is no multiple.
template <int O>
void few_outputs(const Source* sources, int64_t count, const float* weights, int64_t depth, const float* bias,
                 bool relu, int64_t rows, float* c) {
  constexpr int kRows = kLanes / O;
  const F32 lowest = splat(relu ? 0.0f : -__builtin_huge_valf());  // NaN is not less
  float start[kLanes];
  for (int i = 0; i < kLanes; ++i) start[i] = bias[i % O];
  for (int64_t first = 0; first < rows; first += kRows) {
    int64_t row[kRows];
    F32 sum[kLanes];
    for (int r = 0; r < kRows; ++r) row[r] = first + r < rows ? first + r : rows - 1;
    for (int i = 0; i < kLanes; ++i) sum[i] = splat(0.0f);
    const float* w = weights;
    for (const Source* source = sources; source != sources + count; w += source->depth, ++source) {
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
