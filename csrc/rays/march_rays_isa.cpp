// The CPU kernels of march_rays, compiled once per instruction set.
//
// Strata are processed in words of 32. Their positions are computed without branches, which the compiler vectorises;
// each voxel is looked up by a byte load. A ray that has its maximum of samples stops after the current word.
//
// Whole images have many strata, most of them empty, and their samples are middles. For them, a vector holds rays
// instead of strata, and each ray leaps to the next stratum that may be occupied (`leap`). `leap` tests the same
// middles with the same arithmetic, so the samples have the same bits.
#include "rays/march_rays_isa.h"

#include "common/memory_tile.h"
#include "common/simd.h"
#include "rays/march_rays_math.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

typedef int32_t Ints __attribute__((vector_size(4 * kLanes)));

constexpr int64_t kUnit = 16;      // samples that are written together
constexpr int64_t kTogether = 32;  // rays that leap together; 16 would not hide the latency of a step

// The kind of the grid's space, as a type.
template <MarchWhere W>
struct Space {
  static constexpr MarchWhere kWhere = W;
};

// Computes the voxels of 32 strata from `first` on, -1 outside the box.
template <MarchWhere W, typename Spacing>
VN_INLINE void cells_of(const MarchInputs& in, const MarchRay& ray, const float* origin, const float* direction,
                        const float* scale, const float* uniforms, int64_t first, int32_t* cells) {
  float edges[kMarchWord + 1];
  for (int64_t j = 0; j <= kMarchWord; ++j) edges[j] = march_edge<Spacing>(ray, first + j);
  for (int64_t j = 0; j < kMarchWord; ++j) {
    const float at = march_sample<Spacing>(ray, first + j, uniforms[j], edges[j], edges[j + 1]);
    float point[3];
    march_point(in, W, origin, direction, at, point);
    cells[j] = march_cell(in, scale, point);
  }
}

VN_INLINE int bits_of(uint32_t word) { return __builtin_popcount(word); }

template <MarchWhere W, typename Spacing>
void count(const MarchInputs& in, uint32_t* mask, int32_t* counts, int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  float scale[3];
  march_scale(in, scale);
  for (int64_t i = begin; i < end; ++i) {
    const MarchRay ray = march_ray(in, i);
    uint32_t* ray_mask = mask + i * words;
    for (int64_t w = 0; w < words; ++w) ray_mask[w] = 0;
    const int64_t start = in.start == nullptr || in.start[i] < 0 ? 0 : in.start[i];
    const uint32_t key = march_key(in, i);
    int64_t samples = 0;
    for (int64_t w = start / kMarchWord; ray.far > ray.near && w < words && samples < in.max_samples; ++w) {
      const int64_t first = w * kMarchWord, left = in.s - first;
      int32_t cells[kMarchWord];
      float uniforms[kMarchWord];
      if (in.seed != nullptr) {
        for (int64_t j = 0; j < kMarchWord; ++j) uniforms[j] = hashed(key, static_cast<uint32_t>(first + j));
      } else {
        const int64_t size = left < kMarchWord ? left : kMarchWord;
        for (int64_t j = 0; j < kMarchWord; ++j) uniforms[j] = 0.5f;
        if (in.uniforms != nullptr) __builtin_memcpy(uniforms, in.uniforms + i * in.s + first, sizeof(float) * size);
      }
      cells_of<W, Spacing>(in, ray, in.origins + 3 * i, in.directions + 3 * i, scale, uniforms, first, cells);
      uint32_t word = 0;
      for (int64_t j = 0; j < kMarchWord; ++j) {
        // No branch, since it would be unpredictable.
        const uint32_t inside = cells[j] >= 0, occupied = in.occupied[inside ? cells[j] : 0];
        word |= (occupied & inside) << j;
      }
      if (left < kMarchWord) word &= (uint32_t{1} << left) - 1;
      if (start > first) word &= ~uint32_t{0} << (start - first);
      // Drop the last bits beyond the maximum.
      while (samples + bits_of(word) > in.max_samples) word &= ~(uint32_t{1} << (31 - __builtin_clz(word)));
      ray_mask[w] = word;
      samples += bits_of(word);
    }
    counts[i] = static_cast<int32_t>(samples);
  }
}

// Returns whether strata are wide compared with the rounding of their depths. Then a stratum's middle lies between its
// edges, and a depth determines its stratum.
template <typename Spacing>
VN_INLINE bool wide(const MarchRay& ray) {
  const float largest = __builtin_fmaxf(__builtin_fabsf(ray.near), __builtin_fabsf(ray.far));
  return ray.far > ray.near && Spacing::has_inverse(ray) && ray.far - ray.near >= 1e-5f * ray.count * largest;
}

// Returns an upper bound on the voxels that a ray crosses per unit of distance, valid for the next kMarchRoom voxels.
// `width` is the size of a voxel in the grid's space.
template <MarchWhere W>
VN_INLINE float pace_of(const MarchInputs& in, float width, const float* origin, const float* direction, float length,
                        float at, const float* point) {
  const float room = kMarchRoom * width;
  if (W == MarchWhere::kSphere) {
    // At a distance of r >= 1 radii the contraction scales lengths along the radius by 1 / r^2, and lengths across it
    // by (2 - 1 / r) / r. Both factors decrease with r, and so does the angle between an outward ray and the radius.
    // For any other ray the bound uses the smallest r that it can reach.
    const float *centre = in.space.sphere, inverse = 1.0f / centre[3];
    float square = 0.0f, outwards = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
      const float offset = (origin[axis] + at * direction[axis] - centre[axis]) * inverse;
      square += offset * offset;
      outwards += offset * direction[axis];
    }
    const float r = __builtin_sqrtf(square), inverse_r = 1.0f / (r < 1.0f ? 1.0f : r),
                across = (2.0f - inverse_r) * inverse_r;
    const float nearest = r - room * inverse / across, share = 1.0f / (nearest < 1.0f ? 1.0f : nearest);
    const float along = inverse_r * inverse_r, part = outwards * inverse_r, parts = part * part;
    const float leaving = across * across * (length * length - parts) + along * along * parts;
    const float falling = 1.001f * __builtin_sqrtf(leaving < 0.0f ? 0.0f : leaving);
    const float any = (2.0f - share) * share * length;
    return ((outwards > 0.0f) & (r > 1.0f) ? falling : any) / width;
  }
  if (W == MarchWhere::kPerspective) {
    // A perspective maps lines to lines, on which a point at depth z moves at a speed proportional to 1 / z^2. The
    // bound holds down to three quarters of the current depth. Where depths are clamped there is no bound.
    const float *axes = in.space.perspective + 3, *slopes = in.space.perspective + 12;
    float forwards[3] = {};
    for (int axis = 0; axis < 3; ++axis) {
      for (int i = 0; i < 3; ++i) forwards[i] += axes[3 * i + axis] * direction[axis];
    }
    const float depth = 2.0f * slopes[0] / (1.0f - point[2]), inverse = 1.0f / depth;
    const float x = __builtin_fabsf(forwards[0] / slopes[1] - point[0] * forwards[2]) * inverse;
    const float y = __builtin_fabsf(forwards[1] / slopes[2] - point[1] * forwards[2]) * inverse;
    const float z = 2.0f * slopes[0] * __builtin_fabsf(forwards[2]) * inverse * inverse;
    const float sideways = x < y ? y : x, most = sideways < z ? z : sideways, nearing = (4.0f / 3.0f) * most;
    // Towards the camera, a leap is at most a quarter of the depth.
    const float back = -forwards[2] * (4.0f * kMarchRoom) * inverse * width;
    const float speed = forwards[2] < 0.0f ? nearing : most;
    const float pace = 1.001f * (speed < back ? back : speed) / width;
    return 0.75f * depth > 0.5f * slopes[0] ? pace : __builtin_huge_valf();
  }
  return length / width;
}

constexpr int32_t kToWalk = -1;  // marks a ray whose count is not yet known

// The rays that leap together, one per lane: each ray's number, current stratum and state.
struct Walk {
  int32_t ray[kTogether], stratum[kTogether], samples[kTogether];
  float near[kTogether], far[kTogether], from[3][kTogether], along[3][kTogether], length[kTogether], slack[kTogether],
      share[kTogether];
};

template <typename Spacing>
VN_INLINE void enter(const MarchInputs& in, float width, int64_t i, int64_t j, Walk& walk) {
  const MarchRay ray = march_ray(in, i);
  float away = 0.0f, square = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    walk.from[axis][j] = in.origins[3 * i + axis], walk.along[axis][j] = in.directions[3 * i + axis];
    away += __builtin_fabsf(walk.from[axis][j]);
    square += walk.along[axis][j] * walk.along[axis][j];
  }
  walk.ray[j] = static_cast<int32_t>(i), walk.samples[j] = 0;
  walk.stratum[j] = in.start == nullptr || in.start[i] < 0 ? 0 : in.start[i];
  walk.near[j] = ray.near, walk.far[j] = ray.far, walk.length[j] = __builtin_sqrtf(square);
  // slack: the rounding error of a position, in voxels. share: the number of strata per unit of `progress`
  // (march_rays_math.h).
  walk.slack[j] = 1e-3f + 1e-6f * (away + __builtin_fabsf(ray.far) * walk.length[j]) / width;
  walk.share[j] = Spacing::rate(ray) * ray.count;
}

// Marches the rays of [begin, end) whose count is kToWalk, through the middles of strata. From an empty voxel a ray
// leaps the distance within which no voxel can be occupied. A lane whose ray has ended takes the next ray.
template <MarchWhere W, typename Spacing>
VN_INLINE void leap(const MarchInputs& in, const uint8_t* room, const float* scale, uint32_t* mask, int32_t* counts,
                    int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  const int32_t strata = static_cast<int32_t>(in.s);
  const float width = 1.0f / __builtin_fmaxf(scale[0], __builtin_fmaxf(scale[1], scale[2]));
  const float sides[3] = {static_cast<float>(in.x), static_cast<float>(in.y), static_cast<float>(in.z)};
  // Let p be a position along the ray in units of strata. p + `before`, truncated, is the first stratum whose middle is
  // at or behind p, with a tolerance of 0.01 strata plus rounding errors.
  const float count = static_cast<float>(in.s), before = 0.5f - (0.01f + 2e-6f * count);
  const MarchRay any = march_ray(in, begin);  // all rays have the same number of strata
  Walk walk;
  int64_t next_ray = begin;
  // Lanes whose ray has ended, and lanes that have a ray.
  uint32_t ended = ~uint32_t{0} >> (32 - kTogether), active = ended;
  for (int64_t j = 0; j < kTogether; ++j) walk.ray[j] = -1;
  while (true) {
    for (; ended != 0; ended &= ended - 1) {
      const int64_t j = __builtin_ctz(ended);
      if (walk.ray[j] >= 0) counts[walk.ray[j]] = walk.samples[j];
      while (next_ray < end && counts[next_ray] != kToWalk) ++next_ray;
      if (next_ray < end) {
        enter<Spacing>(in, width, next_ray++, j, walk);
        continue;
      }
      enter<Spacing>(in, width, begin, j, walk);  // any ray: the lane's results are ignored
      walk.ray[j] = -1, walk.stratum[j] = strata;
      active &= ~(1u << j);
    }
    if (active == 0) break;
    int32_t cells[kTogether], rooms[kTogether], next[kTogether];
    float places[3][kTogether], free[kTogether], depth[kTogether], pace[kTogether];
    for (int64_t j = 0; j < kTogether; ++j) {
      const float o[3] = {walk.from[0][j], walk.from[1][j], walk.from[2][j]};
      const float d[3] = {walk.along[0][j], walk.along[1][j], walk.along[2][j]};
      const MarchRay ray{walk.near[j], walk.far[j], any.count, any.share};
      const float at = Spacing::depth(ray, march_fraction(ray, static_cast<float>(walk.stratum[j]) + 0.5f));
      float point[3];
      march_point(in, W, o, d, at, point);
      cells[j] = march_cell(in, scale, point);
      for (int axis = 0; axis < 3; ++axis) places[axis][j] = (point[axis] - in.box[axis]) * scale[axis];
      depth[j] = at;
      pace[j] = pace_of<W>(in, width, o, d, walk.length[j], at, point);
    }
    for (int64_t j = 0; j < kTogether; j += kLanes) {
      const F32 one = splat(1.0f);
      F32 border = one;
      for (int axis = 0; axis < 3; ++axis) {
        const F32 inside = min(max(load(places[axis] + j), splat(0.0f)), splat(sides[axis]));
        const F32 part = inside - __builtin_convertvector(__builtin_convertvector(inside, Ints), F32);
        border = min(border, min(part, one - part));
      }
      store(free + j, border - load(walk.slack + j));
    }
    for (int64_t j = 0; j < kTogether; ++j) rooms[j] = room[cells[j] < 0 ? 0 : cells[j]];
    for (int64_t j = 0; j < kTogether; ++j) rooms[j] = cells[j] < 0 ? -kMarchRoom : rooms[j];
    for (int64_t j = 0; j < kTogether; ++j) {
      const float cellwise = static_cast<float>(rooms[j] - 1) + free[j];
      const float to = depth[j] + (cellwise < 0.0f ? 0.0f : cellwise) / pace[j];
      const float place = Spacing::progress(walk.near[j], to) * walk.share[j] + before;
      const float ahead = place < count ? place : count;
      const int32_t far = static_cast<int32_t>(place >= 0.0f ? ahead : 0.0f), one = walk.stratum[j] + 1;
      next[j] = far < one ? one : far;
    }
    uint32_t hits = 0;
    for (int j = 0; j < kTogether; ++j) hits |= (rooms[j] == 0 ? 1u : 0u) << j;
    hits &= active;
    for (; hits != 0; hits &= hits - 1) {
      const int64_t j = __builtin_ctz(hits);
      mask[walk.ray[j] * words + walk.stratum[j] / kMarchWord] |= uint32_t{1} << (walk.stratum[j] % kMarchWord);
      if (++walk.samples[j] == in.max_samples) next[j] = strata;
    }
    for (int64_t j = 0; j < kTogether; ++j) {
      walk.stratum[j] = next[j];
      ended |= static_cast<uint32_t>(next[j] >= strata) << j;
    }
    ended &= active;
  }
}

template <MarchWhere W, typename Spacing>
VN_INLINE void count_by_leaps(const MarchInputs& in, const uint8_t* room, uint32_t* mask, int32_t* counts,
                              int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  float scale[3];
  march_scale(in, scale);
  for (int64_t i = begin; i < end; ++i) {
    const bool ended = in.start != nullptr && in.start[i] >= in.s;
    if (ended || !wide<Spacing>(march_ray(in, i))) {
      count<W, Spacing>(in, mask, counts, i, i + 1);
      continue;
    }
    for (int64_t w = i * words; w < (i + 1) * words; ++w) mask[w] = 0;
    counts[i] = kToWalk;
  }
  leap<W, Spacing>(in, room, scale, mask, counts, begin, end);
}

// Writes the samples in `strata`, at most kUnit of one ray, to the rows from `row` on.
template <MarchWhere W, typename Spacing>
__attribute__((noinline)) void fill_unit(const MarchInputs& in, const MarchRay& ray, uint32_t key, int64_t i,
                                         const int32_t* strata, int64_t size, int64_t row, int32_t* ray_index,
                                         float* depths, float* deltas, float* positions) {
  const float *origin = in.origins + 3 * i, *direction = in.directions + 3 * i;
  float inside[kUnit], at[kUnit], length[kUnit], x[kUnit], y[kUnit], z[kUnit];
  if (in.seed != nullptr) {
    for (int64_t j = 0; j < kUnit; ++j) inside[j] = hashed(key, static_cast<uint32_t>(strata[j]));
  } else {
    for (int64_t j = 0; j < kUnit; ++j) inside[j] = 0.5f;
    for (int64_t j = 0; in.uniforms != nullptr && j < size; ++j) inside[j] = in.uniforms[i * in.s + strata[j]];
  }
  for (int64_t j = 0; j < kUnit; ++j) {
    const float first = march_edge<Spacing>(ray, strata[j]), last = march_edge<Spacing>(ray, strata[j] + 1);
    at[j] = march_sample<Spacing>(ray, strata[j], inside[j], first, last);
    length[j] = last - first;
    float point[3];
    march_point(in, W, origin, direction, at[j], point);
    x[j] = point[0], y[j] = point[1], z[j] = point[2];
  }
  for (int64_t j = 0; j < size; ++j, ++row) {
    ray_index[row] = static_cast<int32_t>(i);
    depths[row] = at[j];
    deltas[row] = length[j];
    positions[3 * row] = x[j], positions[3 * row + 1] = y[j], positions[3 * row + 2] = z[j];
  }
}

template <MarchWhere W, typename Spacing>
VN_INLINE void fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index,
                    float* depths, float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  const int64_t words = march_words(in.s);
  for (int64_t i = begin; i < end; ++i) {
    const MarchRay ray = march_ray(in, i);
    const uint32_t* ray_mask = mask + i * words;
    const uint32_t key = march_key(in, i);
    const int64_t room = offsets[i + 1] - offsets[i];
    int64_t filled = 0, next = in.s, row = offsets[i], waiting = 0;
    int32_t strata[kUnit] = {};
    bool cut = false;
    for (int64_t w = 0; w < words && !cut; ++w) {
      for (uint32_t word = ray_mask[w]; word != 0; word &= word - 1) {
        const int64_t stratum = w * kMarchWord + __builtin_ctz(word);
        if (filled == room) {
          next = stratum;
          cut = true;
          break;
        }
        if (waiting == kUnit) {
          fill_unit<W, Spacing>(in, ray, key, i, strata, kUnit, row, ray_index, depths, deltas, positions);
          row += kUnit;
          waiting = 0;
        }
        strata[waiting++] = static_cast<int32_t>(stratum);
        if (++filled == in.max_samples) next = stratum + 1;
      }
    }
    if (waiting > 0) {
      fill_unit<W, Spacing>(in, ray, key, i, strata, waiting, row, ray_index, depths, deltas, positions);
    }
    stop[i] = static_cast<int32_t>(next);
  }
}

// Calls `run` with the types of the grid's space and of the spacing.
template <typename Run>
VN_INLINE void specialised(const MarchInputs& in, const Run& run) {
  march_by_spacing(in.spacing, [&](auto spacing) {
    const MarchWhere where = march_where(in);
    if (where == MarchWhere::kSphere) return run(Space<MarchWhere::kSphere>(), spacing);
    if (where == MarchWhere::kPerspective) return run(Space<MarchWhere::kPerspective>(), spacing);
    return run(Space<MarchWhere::kWorld>(), spacing);
  });
}

}  // namespace

void march_count(const MarchInputs& in, const uint8_t* room, uint32_t* mask, int32_t* counts, int64_t begin,
                 int64_t end) {
  specialised(in, [&](auto space, auto spacing) {
    if (room != nullptr) {
      count_by_leaps<space.kWhere, decltype(spacing)>(in, room, mask, counts, begin, end);
    } else {
      count<space.kWhere, decltype(spacing)>(in, mask, counts, begin, end);
    }
  });
}

void march_fill(const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index, float* depths,
                float* deltas, float* positions, int32_t* stop, int64_t begin, int64_t end) {
  specialised(in, [&](auto space, auto spacing) {
    fill<space.kWhere, decltype(spacing)>(in, mask, offsets, ray_index, depths, deltas, positions, stop, begin, end);
  });
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
