// Arithmetic of the encodings on CUDA; the CPU tests exercise it too. The CPU's vector form is in elementwise_math.h.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "common/hd.h"

namespace voronerf {

// sine_of_octave returns sin(angle + half pi): the sine for half = 0, the cosine for half = 0.5. With angle = (m -
// half) pi + r and |r| <= pi / 2 it is (-1)^m sin r. Pi is split into two floats for fused multiply-adds, so that r has
// only rounding errors for angles up to kLargestDeviceAngle. The polynomial's error is 5e-9. Larger angles and NaN use
// the library's function with its full range reduction.
constexpr float kLargestDeviceAngle = 65536.0f;

VN_HD float sine_of_octave(float angle, float half) {
  if (!(fabsf(angle) <= kLargestDeviceAngle)) return half == 0.0f ? sinf(angle) : cosf(angle);
  const float shifted = fmaf(angle, 0.318309886f, half) + 12582912.0f;  // rounds to the nearest integer
  const float multiple = (shifted - 12582912.0f) - half;
  const float r = fmaf(multiple, 8.74227765734758577e-8f, fmaf(multiple, -3.14159274101257324f, angle));
  const float u = r * r;
  float p = fmaf(u, 2.59944752e-06f, -1.98063418e-04f);
  p = fmaf(u, p, 8.33301353e-03f);
  p = fmaf(u, p, -1.66666569e-01f);
  const float value = fmaf(r * u, p, r);
  int32_t parity;
  memcpy(&parity, &shifted, sizeof parity);
  return (parity & 1) != 0 ? -value : value;
}

// Returns 2^octave, for octaves below 128; products with it are exact.
VN_HD float octave_scale(int octave) {
  const int32_t bits = (octave + 127) << 23;
  float scale;
  memcpy(&scale, &bits, sizeof scale);
  return scale;
}

// Returns the damping factor of an octave for a Gaussian with this variance.
VN_HD float octave_blur(float scale, float variance) { return expf(-0.5f * scale * scale * variance); }

}  // namespace voronerf
