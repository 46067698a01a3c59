// Updates an occupancy grid from rendered samples, in place: x, y, z cells, m samples. The formula is in
// voronerf/ops/observe_occupancy.
#pragma once

#include <cstdint>

namespace voronerf {

struct ObservedSamples {
  const float *positions, *sigma, *deltas, *weights;  // [m,3], [m], [m], [m]
  const float* box;                                   // [2,3]
  int64_t x, y, z, m;
  float decay, threshold, hidden;
};

// density, occupied: [x,y,z]. cells, before: [m], working memory.
void observe_occupancy_cpu(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* before,
                           int threads);
void observe_occupancy_cuda(const ObservedSamples& in, float* density, uint8_t* occupied, int32_t* cells, float* before,
                            void* stream);

// The same over several ranks. A row of `told` [c,2] is a cell, as bits, and the density that a sample of another rank
// gives it; cells out of `reached` [x,y,z] are left alone. cells, before: [m+c].
void observe_told_cpu(const ObservedSamples& in, const float* told, int64_t c, const uint8_t* reached, float* density,
                      uint8_t* occupied, int32_t* cells, float* before, int threads);
// Writes such rows, of the samples in cells of `several` [x,y,z], or of all where that is null; returns how many.
int64_t tell_observed_cpu(const ObservedSamples& in, const uint8_t* several, float* told, int threads);

}  // namespace voronerf
