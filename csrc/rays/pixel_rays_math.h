// Arithmetic of pixel_rays for one ray, on the CPU and on CUDA.
#pragma once

#include <cmath>
#include <cstdint>

#include "common/hd.h"
#include "rays/pixel_rays.h"

namespace voronerf {

// Returns a pixel's entry in the lens table; null for a camera without distortion.
VN_HD const float* table_entry(const PixelRaysInputs& in, int64_t camera, int64_t pixel) {
  if (in.tables == nullptr) return nullptr;
  const int64_t table = in.lens[camera];
  return table < 0 || table >= in.l ? nullptr : in.tables + 2 * (table * in.h * in.w + pixel);
}

VN_HD void pixel_direction(const PixelRaysInputs& in, int64_t camera, int64_t x, int64_t y, float* direction) {
  const float* lens = in.intrinsics + 4 * camera;
  const float* pose = in.poses + 16 * camera;
  const float px = static_cast<float>(x) + 0.5f, py = static_cast<float>(y) + 0.5f;
  float u = (px - lens[2]) / lens[0], v = (py - lens[3]) / lens[1], ahead = 1.0f;
  if (const float* entry = table_entry(in, camera, y * in.w + x)) {
    u = 2 * entry[0];
    v = 2 * entry[1];
    ahead = 1.0f - (entry[0] * entry[0] + entry[1] * entry[1]);
  }
  float square = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    direction[axis] = pose[4 * axis] * u - pose[4 * axis + 1] * v - pose[4 * axis + 2] * ahead;
    square += direction[axis] * direction[axis];
  }
  float length = sqrtf(square);
  if (length < 1e-12f) length = 1e-12f;
  for (int axis = 0; axis < 3; ++axis) direction[axis] /= length;
}

// Like std::min and std::max, which CUDA lacks: if an argument is NaN, they return the first argument.
VN_HD float smaller(float a, float b) { return b < a ? b : a; }
VN_HD float larger(float a, float b) { return a < b ? b : a; }

// Intersects a ray with the box by the slab method. A ray that misses gets near = far.
VN_HD void meet_box(const PixelRaysInputs& in, const float* origin, const float* direction, float& near, float& far) {
  float enter = -INFINITY, leave = INFINITY;
  for (int axis = 0; axis < 3; ++axis) {
    const float bottom = in.box[axis], top = in.box[3 + axis];
    if (direction[axis] == 0.0f) {  // inside the slab everywhere or nowhere
      if (origin[axis] < bottom || origin[axis] > top) enter = INFINITY, leave = -INFINITY;
      continue;
    }
    const float one = (bottom - origin[axis]) / direction[axis], other = (top - origin[axis]) / direction[axis];
    enter = larger(enter, smaller(one, other));
    leave = smaller(leave, larger(one, other));
  }
  near = smaller(larger(enter, in.near), in.far);
  far = larger(near, smaller(larger(leave, in.near), in.far));
}

VN_HD void pixel_colour(const PixelRaysInputs& in, const uint8_t* pixel, int64_t ray, float* colour) {
  for (int channel = 0; channel < 3; ++channel) colour[channel] = static_cast<float>(pixel[channel]) / 255.0f;
  if (in.channels < 4 || in.background == nullptr) return;
  const float* background = in.background + (in.background_per_ray ? 3 * ray : 0);
  const float alpha = static_cast<float>(pixel[3]) / 255.0f;
  for (int channel = 0; channel < 3; ++channel) {
    colour[channel] = colour[channel] * alpha + background[channel] * (1.0f - alpha);
  }
}

// Computes ray number `ray`. A pixel index out of range, which the CPU has already rejected, is clamped.
VN_HD void pixel_ray(const PixelRaysInputs& in, const PixelRaysOutputs& out, int64_t ray) {
  const int64_t pixels_per_image = in.h * in.w, last = in.c * pixels_per_image - 1, index = in.pixels[ray];
  const int64_t number = index < 0 ? 0 : index < last ? index : last;
  const int64_t camera = number / pixels_per_image, pixel = number - camera * pixels_per_image, y = pixel / in.w;
  float *origin = out.origins + 3 * ray, *direction = out.directions + 3 * ray;
  for (int axis = 0; axis < 3; ++axis) origin[axis] = in.poses[16 * camera + 4 * axis + 3];
  pixel_direction(in, camera, pixel - y * in.w, y, direction);
  out.near[ray] = in.near;
  out.far[ray] = in.far;
  if (in.box != nullptr) meet_box(in, origin, direction, out.near[ray], out.far[ray]);
  pixel_colour(in, in.images + in.channels * number, ray, out.colour + 3 * ray);
}

}  // namespace voronerf
