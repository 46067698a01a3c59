// The derivative of the density to the last of a network's outputs: of a softplus, 1 - exp(-density / scale) times the
// scale; 1 where that output is the density itself.
#pragma once

#include <cmath>

namespace voronerf {

inline float density_slope(float density, float scale, bool activated) {
  return activated ? 1.0f : -scale * std::expm1(-density / scale);
}

}  // namespace voronerf
