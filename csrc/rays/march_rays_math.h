// Arithmetic of march_rays for one stratum, on the CPU and on CUDA. Each operation is rounded separately, as in the
// reference, so that a sample lies in the same voxel on every device. The build turns contraction off for C++; nvcc
// contracts, but not products written as march_product.
#pragma once

#include "common/hashed.h"
#include "rays/march_rays.h"

namespace voronerf {

VN_HD float march_product(float a, float b) {
#ifdef __CUDA_ARCH__
  return __fmul_rn(a, b);
#else
  return a * b;
#endif
}

VN_HD float march_root(float a) {
#ifdef __CUDA_ARCH__
  return __fsqrt_rn(a);
#else
  return __builtin_sqrtf(a);
#endif
}

struct MarchRay {
  float near, far, count, share;  // share: 1 / count if that is exact, else 0
};

VN_HD MarchRay march_ray(const MarchInputs& in, int64_t i) {
  const float count = static_cast<float>(in.s);
  return {in.near[i], in.far[i], count, (in.s & (in.s - 1)) == 0 ? 1.0f / count : 0.0f};
}

// Returns the fraction of the ray that `strata` strata cover. A product with an exact reciprocal equals the quotient.
VN_HD float march_fraction(const MarchRay& ray, float strata) {
  return ray.share > 0.0f ? march_product(strata, ray.share) : strata / ray.count;
}

// A spacing: the depth at a fraction of the ray, and its inverse. The fraction at a depth is `progress` times `rate` if
// has_inverse returns true.
struct MarchLinear {
  VN_HD float depth(const MarchRay& ray, float fraction) {
    return ray.near + march_product(ray.far - ray.near, fraction);
  }
  VN_HD float progress(float near, float depth) { return depth - near; }
  VN_HD float rate(const MarchRay& ray) { return 1.0f / (ray.far - ray.near); }
  VN_HD bool has_inverse(const MarchRay&) { return true; }
};

struct MarchDisparity {
  VN_HD float depth(const MarchRay& ray, float fraction) {
    const float inverse = march_product(ray.far, 1.0f - fraction) + march_product(ray.near, fraction);
    return march_product(ray.near, ray.far) / (inverse < 1.17549435e-38f ? 1.17549435e-38f : inverse);
  }
  VN_HD float progress(float near, float depth) { return 1.0f - near / depth; }
  VN_HD float rate(const MarchRay& ray) { return ray.far / (ray.far - ray.near); }
  VN_HD bool has_inverse(const MarchRay& ray) { return ray.near > 0.0f; }
};

// Calls `run` with the struct of the spacing.
template <typename Run>
VN_HD auto march_by_spacing(MarchSpacing spacing, const Run& run) {
  return spacing == MarchSpacing::disparity ? run(MarchDisparity()) : run(MarchLinear());
}

template <typename Spacing>
VN_HD float march_edge(const MarchRay& ray, int64_t i) {
  const float number = static_cast<float>(i);
  return number < ray.count ? Spacing::depth(ray, march_fraction(ray, number)) : ray.far;
}

template <typename Spacing>
VN_HD float march_sample(const MarchRay& ray, int64_t i, float inside, float first, float last) {
  const float at = Spacing::depth(ray, march_fraction(ray, static_cast<float>(i) + inside));
  const float above = at < first ? first : at;
  return above > last ? last : above;
}

VN_HD uint32_t march_key(const MarchInputs& in, int64_t i) { return in.seed == nullptr ? 0 : hash_key(*in.seed, i); }

// Returns the relative position of a sample in its stratum, in 0..1.
VN_HD float march_inside(const MarchInputs& in, uint32_t key, int64_t i, int64_t stratum) {
  if (in.seed != nullptr) return hashed(key, static_cast<uint32_t>(stratum));
  return in.uniforms != nullptr ? in.uniforms[i * in.s + stratum] : 0.5f;
}

enum class MarchWhere { kWorld, kSphere, kPerspective };

VN_HD MarchWhere march_where(const MarchInputs& in) {
  if (in.space.sphere != nullptr) return MarchWhere::kSphere;
  return in.space.perspective != nullptr ? MarchWhere::kPerspective : MarchWhere::kWorld;
}

// Computes the point at a distance along a ray, in the space of the grid.
VN_HD void march_point(const MarchInputs& in, MarchWhere where, const float* origin, const float* direction, float at,
                       float* point) {
  for (int axis = 0; axis < 3; ++axis) point[axis] = origin[axis] + march_product(at, direction[axis]);
  if (where == MarchWhere::kSphere) {
    const float *centre = in.space.sphere, radius = in.space.sphere[3], scale = 1.0f / radius;
    for (int axis = 0; axis < 3; ++axis) point[axis] = march_product(point[axis] - centre[axis], scale);
    const float distance = march_root(march_product(point[0], point[0]) + march_product(point[1], point[1]) +
                                      march_product(point[2], point[2]));
    const float inverse = 1.0f / (distance < 1.0f ? 1.0f : distance);
    const float factor = march_product(2.0f - inverse, inverse);
    for (int axis = 0; axis < 3; ++axis) {
      point[axis] = centre[axis] + march_product(march_product(radius, point[axis]), factor);
    }
  } else if (where == MarchWhere::kPerspective) {
    const float *centre = in.space.perspective, *slopes = in.space.perspective + 12;
    const float x = point[0] - centre[0], y = point[1] - centre[1], z = point[2] - centre[2];
    float local[3];
    for (int axis = 0; axis < 3; ++axis) {
      const float* along = in.space.perspective + 3 * (axis + 1);
      local[axis] = march_product(x, along[0]) + march_product(y, along[1]) + march_product(z, along[2]);
    }
    const float nearest = slopes[0] / 2.0f;
    const float depth = local[2] < nearest ? nearest : local[2];
    point[0] = local[0] / march_product(depth, slopes[1]);
    point[1] = local[1] / march_product(depth, slopes[2]);
    point[2] = 1.0f - march_product(2.0f, slopes[0]) / depth;
  }
}

// Returns the voxel at a point, -1 outside the box. scale: voxels per unit of length along each axis.
VN_HD int32_t march_cell(const MarchInputs& in, const float* scale, const float* point) {
  const int64_t size[3] = {in.x, in.y, in.z};
  int32_t cell = 0;
  int inside = 1;
  for (int axis = 0; axis < 3; ++axis) {
    const float place = march_product(point[axis] - in.box[axis], scale[axis]);
    const int is_inside = (place >= 0.0f) & (place <= static_cast<float>(size[axis]));
    const int32_t count = static_cast<int32_t>(size[axis]), index = static_cast<int32_t>(is_inside ? place : 0.0f);
    cell = cell * count + (index < count ? index : count - 1);
    inside &= is_inside;
  }
  return inside ? cell : -1;
}

VN_HD void march_scale(const MarchInputs& in, float* scale) {
  const int64_t size[3] = {in.x, in.y, in.z};
  for (int axis = 0; axis < 3; ++axis) {
    scale[axis] = static_cast<float>(size[axis]) / (in.box[3 + axis] - in.box[axis]);
  }
}

}  // namespace voronerf
