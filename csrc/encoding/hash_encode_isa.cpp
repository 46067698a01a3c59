// The CPU kernels of the hash encoding, compiled once per instruction set. They loop over blocks of points, and over
// the levels of each block.
//
// For the gradient of the table, the outer loop is over the levels: one thread handles all points of a level. The
// thread sums in the order of the points, and the level's entries stay in the L2 cache.
#include "encoding/hash_encode_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

template <int kFeatures>
struct Width {
  static constexpr int value = kFeatures;
};
template <typename T>
struct Type {
  using Value = T;
};

template <typename Run>
VN_INLINE void for_width(int32_t features, const Run& run) {
  switch (features) {
    case 1:
      return run(Width<1>{});
    case 2:
      return run(Width<2>{});
    case 4:
      return run(Width<4>{});
    default:
      return run(Width<8>{});
  }
}

template <typename Run>
VN_INLINE void for_table(const HashEncoding& in, const Run& run) {
  for_width(in.features, [&](auto width) {
    switch (in.in.type) {
      case TableType::float32:
        return run(width, Type<float>{});
      case TableType::bfloat16:
        return run(width, Type<Bfloat16>{});
      default:
        return run(width, Type<Float16>{});
    }
  });
}

// Calls run(first, rows, places) for each block of points `begin` to `end`; `places` holds the block's scaled
// coordinates.
template <typename Run>
VN_INLINE void for_blocks(const HashEncoding& in, int64_t begin, int64_t end, const Run& run) {
  HashPlaces places;
  for (int64_t first = begin; first < end; first += kHashBlock) {
    const int64_t rows = end - first < kHashBlock ? end - first : kHashBlock;
    hash_places(in, first, rows, places);
    run(first, rows, places);
  }
}

template <bool kSlopes>
VN_INLINE void corners_of(const HashEncoding& in, const GridLevel& level, const HashPlaces& places, int64_t rows,
                          HashCorners& corners) {
  if (in.in.direction != nullptr) {
    hash_corners<true, kSlopes>(level, places, rows, corners);
  } else {
    hash_corners<false, kSlopes>(level, places, rows, corners);
  }
}

}  // namespace

void hash_encode_rows(const HashEncoding& in, float* out, int64_t stride, int64_t begin, int64_t end) {
  for_table(in, [&](auto features, auto type) {
    using T = typename decltype(type)::Value;
    HashCorners corners;
    for_blocks(in, begin, end, [&](int64_t first, int64_t rows, const HashPlaces& places) {
      for (int32_t level = 0; level < in.count; ++level) {
        corners_of<false>(in, in.levels[level], places, rows, corners);
        const int64_t size = in.levels[level].entries * features.value * static_cast<int64_t>(sizeof(T));
        if (size >= kFetchedLevel) hash_fetch<features.value, T>(in, in.levels[level], corners, first, rows);
        hash_interpolate<features.value, T>(in, in.levels[level], corners, first, rows,
                                            out + first * stride + level * features.value, stride);
      }
    });
  });
}

void hash_encode_level(const HashEncoding& in, int64_t level, float* out, int64_t stride, int64_t begin, int64_t end) {
  for_table(in, [&](auto features, auto type) {
    HashCorners corners;
    for_blocks(in, begin, end, [&](int64_t first, int64_t rows, const HashPlaces& places) {
      corners_of<false>(in, in.levels[level], places, rows, corners);
      hash_interpolate<features.value, typename decltype(type)::Value>(in, in.levels[level], corners, first, rows,
                                                                       out + first * stride, stride);
    });
  });
}

void hash_encode_level_backward(const HashEncoding& in, int64_t level, const float* gradient, int64_t stride,
                                int64_t begin, int64_t end, float* of_table) {
  for_width(in.features, [&](auto features) {
    HashCorners corners;
    for_blocks(in, begin, end, [&](int64_t first, int64_t rows, const HashPlaces& places) {
      corners_of<false>(in, in.levels[level], places, rows, corners);
      hash_scatter<features.value>(in, in.levels[level], corners, first, rows,
                                   gradient + first * stride + level * features.value, stride, of_table);
    });
  });
}

void hash_encode_positions_backward(const HashEncoding& in, const float* gradient, int64_t stride, float* of_positions,
                                    int64_t begin, int64_t end) {
  for_table(in, [&](auto features, auto type) {
    HashCorners corners;
    Four sums[3][kHashBlock];
    for_blocks(in, begin, end, [&](int64_t first, int64_t rows, const HashPlaces& places) {
      __builtin_memset(sums, 0, sizeof sums);
      for (int32_t level = 0; level < in.count; ++level) {
        corners_of<true>(in, in.levels[level], places, rows, corners);
        hash_slopes<features.value, typename decltype(type)::Value>(in, in.levels[level], corners, first, rows,
                                                                    gradient + first * stride + level * features.value,
                                                                    stride, sums);
      }
      for (int64_t i = 0; i < rows; ++i) {
        for (int axis = 0; axis < 3; ++axis) {
          const Four sum = sums[axis][i];
          const float slope = places.slope[axis][i];
          // Outside the box the gradient is 0, even where a sum is NaN.
          of_positions[3 * (first + i) + axis] = slope == 0.0f ? 0.0f : slope * ((sum[0] + sum[1]) + (sum[2] + sum[3]));
        }
      }
    });
  });
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
