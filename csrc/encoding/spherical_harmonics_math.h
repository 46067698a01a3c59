// The real spherical harmonics of bands 0 to 3 as polynomials of a direction, in the order, with the signs and
// constants of tiny-cuda-nn; for one direction (T is float) and for a vector of them.
#pragma once

#include "common/hd.h"

namespace voronerf {

constexpr int kMostHarmonics = 16;  // of degree 4

// out [degree^2].
template <typename T>
VN_HD void spherical_harmonics_of(T x, T y, T z, int degree, T* out) {
  out[0] = T{} + 0.28209479177387814f;
  if (degree < 2) return;
  out[1] = -0.48860251190291987f * y;
  out[2] = 0.48860251190291987f * z;
  out[3] = -0.48860251190291987f * x;
  if (degree < 3) return;
  const T xy = x * y, x2 = x * x, y2 = y * y, z2 = z * z;
  out[4] = 1.0925484305920792f * xy;
  out[5] = -1.0925484305920792f * y * z;
  out[6] = 0.94617469575755997f * z2 - 0.31539156525251999f;
  out[7] = -1.0925484305920792f * x * z;
  out[8] = 0.54627421529603959f * (x2 - y2);
  if (degree < 4) return;
  out[9] = 0.59004358992664352f * y * (y2 - 3.0f * x2);
  out[10] = 2.8906114426405538f * xy * z;
  out[11] = 0.45704579946446572f * y * (1.0f - 5.0f * z2);
  out[12] = 0.3731763325901154f * z * (5.0f * z2 - 3.0f);
  out[13] = 0.45704579946446572f * x * (1.0f - 5.0f * z2);
  out[14] = 1.4453057213202769f * z * (x2 - y2);
  out[15] = 0.59004358992664352f * x * (3.0f * y2 - x2);
}

// Gradient to the direction from that to its harmonics, g [degree^2] -> out [3].
template <typename T>
VN_HD void spherical_harmonics_gradient(T x, T y, T z, int degree, const T* g, T* out) {
  out[0] = out[1] = out[2] = T{};
  if (degree < 2) return;
  out[0] = -0.48860251190291987f * g[3];
  out[1] = -0.48860251190291987f * g[1];
  out[2] = 0.48860251190291987f * g[2];
  if (degree < 3) return;
  out[0] = out[0] + 1.0925484305920792f * (y * g[4] - z * g[7] + x * g[8]);
  out[1] = out[1] + 1.0925484305920792f * (x * g[4] - z * g[5] - y * g[8]);
  out[2] = out[2] + 1.8923493915151199f * z * g[6] - 1.0925484305920792f * (y * g[5] + x * g[7]);
  if (degree < 4) return;
  const T xy = x * y, xz = x * z, yz = y * z, difference = x * x - y * y, z2 = z * z;
  const T of_11 = 0.45704579946446572f * (1.0f - 5.0f * z2);
  out[0] = out[0] - 3.5402615395598611f * xy * g[9] + 2.8906114426405538f * yz * g[10] + of_11 * g[13] +
           2.8906114426405538f * xz * g[14] - 1.7701307697799306f * difference * g[15];
  out[1] = out[1] - 1.7701307697799306f * difference * g[9] + 2.8906114426405538f * xz * g[10] + of_11 * g[11] -
           2.8906114426405538f * yz * g[14] + 3.5402615395598611f * xy * g[15];
  out[2] = out[2] + 2.8906114426405538f * xy * g[10] - 4.5704579946446572f * (yz * g[11] + xz * g[13]) +
           1.1195289977703462f * (5.0f * z2 - 1.0f) * g[12] + 1.4453057213202769f * difference * g[14];
}

}  // namespace voronerf
