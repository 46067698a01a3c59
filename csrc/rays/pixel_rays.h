// Rays through the pixels of images, their intersections with a box, and the colours of the pixels: c images of h x w
// pixels, b rays. The formulas are in voronerf/ops/pixel_rays.
#pragma once

#include <cstdint>

#include "common/row_count.h"

namespace voronerf {

struct PixelRaysInputs {
  const float* poses;       // [c,4,4], camera to world
  const float* intrinsics;  // [c,4]: fx, fy, cx, cy
  const int32_t* lens;      // [c], the table of each camera; not in [0, l): no distortion; null if `tables` is null
  const float* tables;      // [l,h,w,2], directions (x, y, z) of pixels in the camera as (x, -y) / (1 - z); or null
  const uint8_t* images;    // [c,h,w,channels]
  const int64_t* pixels;    // [b], numbered across all images
  const float* box;         // [2,3], or null for all of space
  const float* background;  // [b,3], or [3], or null
  bool background_per_ray;
  int64_t c, h, w, channels;
  RowCount b;
  int64_t l;
  float near, far;
};

struct PixelRaysOutputs {
  float *origins, *directions;  // [b,3]
  float *near, *far;            // [b]
  float* colour;                // [b,3]
};

// Returns false, with undefined results, if a pixel index is out of range.
bool pixel_rays_cpu(const PixelRaysInputs& in, const PixelRaysOutputs& out, int threads);

// A pixel index out of range cannot be rejected without a host read; it is clamped to the first or last pixel.
void pixel_rays_cuda(const PixelRaysInputs& in, const PixelRaysOutputs& out, void* stream);

}  // namespace voronerf
