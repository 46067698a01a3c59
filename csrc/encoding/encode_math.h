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

// Turns of any angle that is not small, at least 1 in size: x / 2 pi less the nearest integer, to 2^-30; what is not
// finite is NaN. x is an integer of 24 bits times 2^shift, and of 1 / 2 pi only the bits count whose product with
// it is below 1: 64 of them, from bit `shift` on, a method of Payne and Hanek (1983).
VN_HD float turns_of_large(float x) {
  uint32_t bits;
  memcpy(&bits, &x, sizeof bits);
  const int exponent = static_cast<int>(bits >> 23 & 255u);
  if (exponent == 255) return x - x;
  const uint32_t integer = (bits & 0x7fffffu) | 0x800000u;
  const int first = exponent - 127 - 23 + 32;  // there are 32 zeros before the bits
  const auto word = [](int i) -> uint32_t {
    return i == 0   ? 0u
           : i == 1 ? 0x28be60dbu
           : i == 2 ? 0x9391054au
           : i == 3 ? 0x7f09d5f4u
           : i == 4 ? 0x7d4d3770u
           : i == 5 ? 0x36d8a566u
                    : 0x4f10e410u;
  };
  const int index = first / 32, shift = first % 32;
  const uint64_t high = static_cast<uint64_t>(word(index)) << 32 | word(index + 1);
  const uint64_t low = static_cast<uint64_t>(word(index + 1)) << 32 | word(index + 2);
  const uint32_t upper = static_cast<uint32_t>(high << shift >> 32), lower = static_cast<uint32_t>(low << shift >> 32);
  const uint64_t product = static_cast<uint64_t>(integer) * lower;
  const uint32_t turns = integer * upper + static_cast<uint32_t>(product >> 32);
  const float fraction = static_cast<float>(static_cast<int32_t>(turns)) * 2.32830644e-10f;
  return x < 0.0f ? -fraction : fraction;
}

// 2^octave; products with it are exact.
VN_HD float octave_scale(int octave) { return ldexpf(1.0f, octave); }

// The factor on an octave for a Gaussian of this variance.
VN_HD float octave_blur(float scale, float variance) { return expf(-0.5f * scale * scale * variance); }

}  // namespace voronerf
