// Arithmetic of the encodings on CUDA, which the CPU's tests exercise as well. On the CPU vectors of it are in
// elementwise_math.h.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "common/hd.h"

namespace voronerf {

// sin(angle + half pi): half 0 or 0.5, the cosine. With angle = (m - half) pi + r, |r| <= pi / 2, it is (-1)^m sin r.
// pi in two parts and fused multiply-adds make r exact to rounding up to the largest angle; the polynomial's own error
// is 5e-9. Beyond, and for NaN, the library's own function with its long reduction.
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

// 2^octave, for octaves below 128; products with it are exact.
VN_HD float octave_scale(int octave) {
  const int32_t bits = (octave + 127) << 23;
  float scale;
  memcpy(&scale, &bits, sizeof scale);
  return scale;
}

// The factor on an octave for a Gaussian of this variance.
VN_HD float octave_blur(float scale, float variance) { return expf(-0.5f * scale * scale * variance); }

}  // namespace voronerf
