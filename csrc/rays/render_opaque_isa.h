// The kernel of render_opaque, once for each instruction set.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

// Samples of a wave, and the rays [r] that they belong to, by their numbers in the picture.
struct SeenWave {
  const float* raw;                 // [m,4]
  const float *depths, *deltas;     // [m]
  const int32_t *offsets, *number;  // [r+1], [r]
  float density_scale;
  bool activated;
  double* front;                   // [r], the optical depth so far
  float* most;                     // [r], the largest weight so far, or null
  float* colour;                   // of the picture's rays, as in render_opaque.h
  float *opacity, *depth, *light;  // light: what is left behind the wave
  float* heaviest;
};

VN_DECLARE_FOR_ISA(void see_wave(const SeenWave& in, int64_t r))

}  // namespace voronerf
