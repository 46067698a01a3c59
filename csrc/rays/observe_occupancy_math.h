// Arithmetic of observe_occupancy for one sample, on the CPU and on CUDA.
#pragma once

#include <cmath>
#include <cstdint>

#include "common/hd.h"
#include "rays/observe_occupancy.h"

namespace voronerf {

// Returns the voxel of a sample. A NaN coordinate is in the first voxel of its axis.
VN_HD int64_t observed_cell(const ObservedSamples& in, int64_t i) {
  const int64_t size[3] = {in.x, in.y, in.z};
  int64_t cell = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const float extent = in.box[3 + axis] - in.box[axis], last = static_cast<float>(size[axis] - 1);
    const float place = (in.positions[3 * i + axis] - in.box[axis]) / extent * static_cast<float>(size[axis]);
    const float inside = place > 0.0f ? (place < last ? place : last) : 0.0f;
    cell = cell * size[axis] + static_cast<int64_t>(inside);
  }
  return cell;
}

// Returns whether a sample updates its voxel. It does not if its delta is 0 or the voxel is fixed.
VN_HD bool observes(const ObservedSamples& in, int64_t i, int64_t cell) {
  return (in.deltas == nullptr || in.deltas[i] != 0.0f) && (in.fixed == nullptr || in.fixed[cell] == 0);
}

// Returns the world length of a unit of grid space at a sample; see voronerf/nerf/contraction.py.
VN_HD float observed_stretch(const ObservedSamples& in, int64_t i) {
  const float* point = in.positions + 3 * i;
  if (in.space.sphere != nullptr) {
    const float *centre = in.space.sphere, radius = in.space.sphere[3];
    const float x = point[0] - centre[0], y = point[1] - centre[1], z = point[2] - centre[2];
    const float left = 2.0f - sqrtf(x * x + y * y + z * z) / radius;
    const float inside = left > 1e-3f ? (left < 1.0f ? left : 1.0f) : 1e-3f;
    return 1.0f / (inside * inside);
  }
  if (in.space.perspective != nullptr) {
    const float ahead = 1.0f - point[2], left = ahead > 1e-3f ? ahead : 1e-3f;
    return 2.0f * in.space.perspective[12] / (left * left);
  }
  return 1.0f;
}

// Returns the density that a sample observes in its voxel: its own density per length in the grid's space, or 0 if
// at most the fraction `hidden` of the light reaches it.
VN_HD float observed_density(const ObservedSamples& in, int64_t i) {
  const float density = in.sigma[i] == in.sigma[i] ? in.sigma[i] : INFINITY;
  if (in.weights == nullptr) return density * observed_stretch(in, i);
  const float thickness = density * in.deltas[i];
  // 1 - exp(-t) <= min(t, 1), so that most samples skip expm1f.
  const bool seen = in.weights[i] > in.hidden * (thickness < 1.0f ? thickness : 1.0f) ||
                    in.weights[i] > in.hidden * -expm1f(-thickness);
  return seen ? density * observed_stretch(in, i) : 0.0f;
}

}  // namespace voronerf
