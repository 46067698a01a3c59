// The CPU kernel of render_opaque, compiled once per instruction set.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

// The samples of a wave, and the numbers [r] of their rays in the image.
struct SeenWave {
  const float* raw;                        // [m,4], colour and density
  const float *depths, *deltas;            // [m]
  const int32_t *offsets, *number;         // [r+1], [r]
  static constexpr bool activated = true;  // as render_tile.h reads `raw`
  static constexpr float density_scale = 1.0f;
  double* front;                   // [r], the optical depth so far
  float* most;                     // [r], the largest weight so far, or null
  float* colour;                   // of the image's rays, as in render_opaque.h
  float *opacity, *depth, *light;  // light: the remaining light behind the wave
  float* heaviest;
};

VN_DECLARE_FOR_ISA(void see_wave(const SeenWave& in, int64_t r))

}  // namespace voronerf
