// The CPU kernels of march_rays, once for each instruction set.
//
// Strata go by in words of 32. Where they lie is arithmetic without branches, which the compiler turns into vectors;
// looking up their cells is a byte load each. Rays that only want a few samples leave after the word that has them.
#include "rays/march_rays_isa.h"

#include "common/simd.h"
#include "rays/march_rays_math.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Cells of 32 strata from `first`, -1 outside the box.
template <MarchWhere W, bool Jittered, bool Disparity>
VN_INLINE void cells_of(const MarchInputs& in, const MarchRay& ray, const float* origin, const float* direction,
                        const float* scale, const float* uniforms, int64_t first, int32_t* cells) {
  float edges[kMarchWord + 1];
  for (int64_t j = 0; j <= kMarchWord; ++j) edges[j] = march_edge(ray, first + j, Disparity);
  for (int64_t j = 0; j < kMarchWord; ++j) {
    const float at = march_sample(ray, first + j, Jittered ? uniforms[j] : 0.5f, edges[j], edges[j + 1], Disparity);
    float point[3];
    march_point(in, W, origin, direction, at, point);
    cells[j] = march_cell(in, scale, point);
  }
}

VN_INLINE int bits_of(uint32_t word) {
  return __builtin_popcount(word);
}

template <MarchWhere W, bool Jittered, bool Disparity>
VN_INLINE void count(const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  float scale[3];
  march_scale(in, scale);
  for (int64_t i = begin; i < end; ++i) {
    const MarchRay ray = march_ray(in, i);
    uint32_t* own = mask + i * words;
    for (int64_t w = 0; w < words; ++w) own[w] = 0;
    const int64_t start = in.start == nullptr || in.start[i] < 0 ? 0 : in.start[i];
    const uint32_t key = march_key(in, i);
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
      cells_of<W, Jittered, Disparity>(in, ray, in.origins + 3 * i, in.directions + 3 * i, scale, uniforms, first,
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

template <MarchWhere W, bool Disparity>
VN_INLINE void fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index,
                    float* depths, float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  for (int64_t i = begin; i < end; ++i) {
    const MarchRay ray = march_ray(in, i);
    const uint32_t* own = mask + i * words;
    int64_t row = offsets[i], got = 0, next = in.s;
    const int64_t room = offsets[i + 1] - row;
    const uint32_t key = march_key(in, i);
    bool cut = false;
    for (int64_t w = 0; w < words && !cut; ++w) {
      for (uint32_t word = own[w]; word != 0; word &= word - 1) {
        const int64_t stratum = w * kMarchWord + __builtin_ctz(word);
        if (got == room) {
          next = stratum;
          cut = true;
          break;
        }
        const float first = march_edge(ray, stratum, Disparity), last = march_edge(ray, stratum + 1, Disparity);
        const float inside = march_inside(in, key, i, stratum);
        ray_index[row] = static_cast<int32_t>(i);
        depths[row] = march_sample(ray, stratum, inside, first, last, Disparity);
        deltas[row] = last - first;
        march_point(in, W, in.origins + 3 * i, in.directions + 3 * i, depths[row], positions + 3 * row);
        ++row;
        if (++got == in.most) next = stratum + 1;
      }
    }
    stop[i] = static_cast<int32_t>(next);
  }
}

template <MarchWhere W>
VN_INLINE void count_in(const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  const bool middles = in.uniforms == nullptr && in.seed == nullptr;
  if (in.disparity) {
    middles ? count<W, false, true>(in, mask, counts, begin, end) : count<W, true, true>(in, mask, counts, begin, end);
  } else {
    middles ? count<W, false, false>(in, mask, counts, begin, end)
            : count<W, true, false>(in, mask, counts, begin, end);
  }
}

template <MarchWhere W>
VN_INLINE void fill_in(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index,
                       float* depths, float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  if (in.disparity) {
    fill<W, true>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  } else {
    fill<W, false>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  }
}

}  // namespace

void march_count(const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  if (in.space.sphere != nullptr) {
    count_in<MarchWhere::kSphere>(in, mask, counts, begin, end);
  } else if (in.space.perspective != nullptr) {
    count_in<MarchWhere::kPerspective>(in, mask, counts, begin, end);
  } else {
    count_in<MarchWhere::kWorld>(in, mask, counts, begin, end);
  }
}

void march_fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index, float* depths,
                float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  if (in.space.sphere != nullptr) {
    fill_in<MarchWhere::kSphere>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  } else if (in.space.perspective != nullptr) {
    fill_in<MarchWhere::kPerspective>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  } else {
    fill_in<MarchWhere::kWorld>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
