// The CPU kernels of march_rays, once for each instruction set.
//
// Strata go by in words of 32. Where they lie is arithmetic without branches, which the compiler turns into vectors;
// looking up their cells is a byte load each. Rays that only want a few samples leave after the word that has them.
// Each operation is rounded on its own, as the reference does it (the build has contraction off): a sample lies in the
// same cell on every path.
#include "rays/march_rays_isa.h"

#include "common/hashed.h"
#include "common/simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

struct Ray {
  float near, far, count;
};

template <bool Disparity>
VN_INLINE float depth_at(const Ray& ray, float fraction) {
  if (!Disparity) return ray.near + (ray.far - ray.near) * fraction;
  const float inverse = ray.far * (1.0f - fraction) + ray.near * fraction;
  return ray.near * ray.far / (inverse < 1.17549435e-38f ? 1.17549435e-38f : inverse);
}

template <bool Disparity>
VN_INLINE float edge_at(const Ray& ray, int64_t i) {
  const float number = static_cast<float>(i);
  return number < ray.count ? depth_at<Disparity>(ray, number / ray.count) : ray.far;
}

template <bool Disparity>
VN_INLINE float sample_at(const Ray& ray, int64_t i, float inside, float first, float last) {
  const float at = depth_at<Disparity>(ray, (static_cast<float>(i) + inside) / ray.count);
  const float above = at < first ? first : at;
  return above > last ? last : above;
}

VN_INLINE uint32_t key_of(const MarchInputs& in, int64_t i) {
  return in.seed == nullptr ? 0 : hash_key(*in.seed, i);
}

enum class Space { kWorld, kSphere, kPerspective };

// The point at a distance along a ray, in the space of the grid.
template <Space S>
VN_INLINE void point_at(const MarchInputs& in, const float* origin, const float* direction, float at, float* point) {
  for (int axis = 0; axis < 3; ++axis) point[axis] = origin[axis] + at * direction[axis];
  if (S == Space::kSphere) {
    const float *centre = in.space.sphere, radius = in.space.sphere[3];
    for (int axis = 0; axis < 3; ++axis) point[axis] = (point[axis] - centre[axis]) / radius;
    const float whole = __builtin_sqrtf(point[0] * point[0] + point[1] * point[1] + point[2] * point[2]);
    const float length = whole < 1.0f ? 1.0f : whole;
    const float factor = (2.0f - 1.0f / length) / length;
    for (int axis = 0; axis < 3; ++axis) point[axis] = centre[axis] + radius * point[axis] * factor;
  } else if (S == Space::kPerspective) {
    const float *centre = in.space.perspective, *slopes = in.space.perspective + 12;
    const float x = point[0] - centre[0], y = point[1] - centre[1], z = point[2] - centre[2];
    float local[3];
    for (int axis = 0; axis < 3; ++axis) {
      const float* along = in.space.perspective + 3 * (axis + 1);
      local[axis] = x * along[0] + y * along[1] + z * along[2];
    }
    const float nearest = slopes[0] / 2.0f;
    const float depth = local[2] < nearest ? nearest : local[2];
    point[0] = local[0] / (depth * slopes[1]);
    point[1] = local[1] / (depth * slopes[2]);
    point[2] = 1.0f - 2.0f * slopes[0] / depth;
  }
}

VN_INLINE Ray ray_of(const MarchInputs& in, int64_t i) {
  return {in.near[i], in.far[i], static_cast<float>(in.s)};
}

// Cells of 32 strata from `first`, -1 outside the box.
template <Space S, bool Jittered, bool Disparity>
VN_INLINE void cells_of(const MarchInputs& in, const Ray& ray, const float* origin, const float* direction,
                        const float* scale, const float* uniforms, int64_t first, int32_t* cells) {
  float edges[kMarchWord + 1];
  for (int64_t j = 0; j <= kMarchWord; ++j) edges[j] = edge_at<Disparity>(ray, first + j);
  const float size[3] = {static_cast<float>(in.x), static_cast<float>(in.y), static_cast<float>(in.z)};
  const int32_t count[3] = {static_cast<int32_t>(in.x), static_cast<int32_t>(in.y), static_cast<int32_t>(in.z)};
  for (int64_t j = 0; j < kMarchWord; ++j) {
    const float at = sample_at<Disparity>(ray, first + j, Jittered ? uniforms[j] : 0.5f, edges[j], edges[j + 1]);
    float point[3];
    point_at<S>(in, origin, direction, at, point);
    int32_t cell = 0;
    int inside = 1;
    for (int axis = 0; axis < 3; ++axis) {
      const float place = (point[axis] - in.box[axis]) * scale[axis];
      const int here = (place >= 0.0f) & (place <= size[axis]);
      const int32_t whole = static_cast<int32_t>(here ? place : 0.0f);
      cell = cell * count[axis] + (whole < count[axis] ? whole : count[axis] - 1);
      inside &= here;
    }
    cells[j] = inside ? cell : -1;
  }
}

VN_INLINE int bits_of(uint32_t word) {
  return __builtin_popcount(word);
}

template <Space S, bool Jittered, bool Disparity>
VN_INLINE void count(const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  const int64_t size[3] = {in.x, in.y, in.z};
  float scale[3];
  for (int axis = 0; axis < 3; ++axis) {
    scale[axis] = static_cast<float>(size[axis]) / (in.box[3 + axis] - in.box[axis]);
  }
  for (int64_t i = begin; i < end; ++i) {
    const Ray ray = ray_of(in, i);
    uint32_t* own = mask + i * words;
    for (int64_t w = 0; w < words; ++w) own[w] = 0;
    const int64_t start = in.start == nullptr || in.start[i] < 0 ? 0 : in.start[i];
    const uint32_t key = key_of(in, i);
    int64_t found = 0;
    for (int64_t w = start / kMarchWord; ray.far > ray.near && w < words && found < in.most; ++w) {
      const int64_t first = w * kMarchWord, left = in.s - first;
      int32_t cells[kMarchWord];
      float uniforms[kMarchWord];
      if (Jittered && in.seed != nullptr) {
        for (int64_t j = 0; j < kMarchWord; ++j) uniforms[j] = hashed(key, static_cast<uint32_t>(first + j));
      } else if (Jittered) {
        const int64_t there = left < kMarchWord ? left : kMarchWord;
        for (int64_t j = 0; j < kMarchWord; ++j) uniforms[j] = 0.0f;
        __builtin_memcpy(uniforms, in.uniforms + i * in.s + first, sizeof(float) * there);
      }
      cells_of<S, Jittered, Disparity>(in, ray, in.origins + 3 * i, in.directions + 3 * i, scale, uniforms, first,
                                       cells);
      uint32_t word = 0;
      for (int64_t j = 0; j < kMarchWord; ++j) {
        // Without a branch, which nothing could predict.
        const uint32_t inside = cells[j] >= 0, taken = in.occupied[inside ? cells[j] : 0];
        word |= (taken & inside) << j;
      }
      if (left < kMarchWord) word &= (uint32_t{1} << left) - 1;
      if (start > first) word &= ~uint32_t{0} << (start - first);
      // The last bits go where there are more than wanted.
      while (found + bits_of(word) > in.most) word &= ~(uint32_t{1} << (31 - __builtin_clz(word)));
      own[w] = word;
      found += bits_of(word);
    }
    counts[i] = static_cast<int32_t>(found);
  }
}

template <Space S, bool Disparity>
VN_INLINE void fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index,
                    float* depths, float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  for (int64_t i = begin; i < end; ++i) {
    const Ray ray = ray_of(in, i);
    const uint32_t* own = mask + i * words;
    int64_t row = offsets[i], got = 0, next = in.s;
    const int64_t room = offsets[i + 1] - row;
    const uint32_t key = key_of(in, i);
    bool cut = false;
    for (int64_t w = 0; w < words && !cut; ++w) {
      for (uint32_t word = own[w]; word != 0; word &= word - 1) {
        const int64_t stratum = w * kMarchWord + __builtin_ctz(word);
        if (got == room) {
          next = stratum;
          cut = true;
          break;
        }
        const float first = edge_at<Disparity>(ray, stratum), last = edge_at<Disparity>(ray, stratum + 1);
        float inside = 0.5f;
        if (in.uniforms != nullptr) inside = in.uniforms[i * in.s + stratum];
        if (in.seed != nullptr) inside = hashed(key, static_cast<uint32_t>(stratum));
        ray_index[row] = static_cast<int32_t>(i);
        depths[row] = sample_at<Disparity>(ray, stratum, inside, first, last);
        deltas[row] = last - first;
        point_at<S>(in, in.origins + 3 * i, in.directions + 3 * i, depths[row], positions + 3 * row);
        ++row;
        if (++got == in.most) next = stratum + 1;
      }
    }
    stop[i] = static_cast<int32_t>(next);
  }
}

template <Space S>
VN_INLINE void count_in(const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  const bool middles = in.uniforms == nullptr && in.seed == nullptr;
  if (in.disparity) {
    middles ? count<S, false, true>(in, mask, counts, begin, end) : count<S, true, true>(in, mask, counts, begin, end);
  } else {
    middles ? count<S, false, false>(in, mask, counts, begin, end)
            : count<S, true, false>(in, mask, counts, begin, end);
  }
}

template <Space S>
VN_INLINE void fill_in(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index,
                       float* depths, float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  if (in.disparity) {
    fill<S, true>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  } else {
    fill<S, false>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  }
}

}  // namespace

void march_count(const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  if (in.space.sphere != nullptr) {
    count_in<Space::kSphere>(in, mask, counts, begin, end);
  } else if (in.space.perspective != nullptr) {
    count_in<Space::kPerspective>(in, mask, counts, begin, end);
  } else {
    count_in<Space::kWorld>(in, mask, counts, begin, end);
  }
}

void march_fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index, float* depths,
                float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  if (in.space.sphere != nullptr) {
    fill_in<Space::kSphere>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  } else if (in.space.perspective != nullptr) {
    fill_in<Space::kPerspective>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  } else {
    fill_in<Space::kWorld>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
