// Samples rays in the occupied voxels of a grid: r rays, s strata each, m kept samples. The formulas are in
// voronerf/ops/march_rays, and every rounded operation is in voronerf/ops/march_rays/reference.py.
//
// There are two calls, since the number of samples is known only after the first call. The first call sets a bit for
// every kept stratum; the second call reads the bits instead of the grid.
#pragma once

#include <cstdint>

#include "common/hd.h"
#include "common/isa.h"
#include "common/row_count.h"

namespace voronerf {

// The space of the grid: contracted by a sphere or a perspective, or if both are null the space of the rays.
struct MarchSpace {
  const float* sphere;       // [4], centre and radius
  const float* perspective;  // [5,3], centre, right, up, ahead and (near, a, b)
};

// The spacing of the strata; each has a struct in march_rays_math.h.
enum class MarchSpacing : int { linear = 0, disparity };

struct MarchInputs {
  const float *origins, *directions;  // [r,3]
  const float *near, *far;            // [r]
  const uint8_t* occupied;            // [x,y,z], 0 or 1
  const float* box;                   // [2,3]
  const float* uniforms;              // [r,s], or null
  const int32_t* seed;                // [1], the seed of hashed uniforms, or null; if both are null, middles
  const int32_t* start;               // [r], the first stratum, or null for 0
  RowCount r;
  int64_t s;
  int64_t x, y, z;
  MarchSpacing spacing;
  int64_t max_samples;  // the maximum number of samples of a ray
  MarchSpace space;
};

// The strata in a word of the mask.
constexpr int64_t kMarchWord = 32;

VN_HD int64_t march_words(int64_t s) { return (s + kMarchWord - 1) / kMarchWord; }

// Requires r * s < 2^31. mask: [r, march_words(s)], bit i of word w for stratum 32 w + i. offsets: [r+1], at most
// capacity.
void march_rays_count_cpu(const MarchInputs& in, uint32_t* mask, int32_t* offsets, int64_t* total, int64_t capacity,
                          Isa isa, int threads);
void march_rays_count_cuda(const MarchInputs& in, uint32_t* mask, int32_t* offsets, int64_t capacity, void* stream);

// rows: length of ray_index, depths, deltas and positions [rows,3], at least offsets[r]; rows from offsets[r] on become
// 0.
void march_rays_fill_cpu(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, RowCount rows,
                         int32_t* ray_index, float* depths, float* deltas, float* positions, int32_t* stop, Isa isa,
                         int threads);
void march_rays_fill_cuda(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int64_t rows,
                          int32_t* ray_index, float* depths, float* deltas, float* positions, int32_t* stop,
                          void* stream);

}  // namespace voronerf
