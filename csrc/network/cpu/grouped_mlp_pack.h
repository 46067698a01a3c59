// Weights of a cell in the order in which the products of grouped_mlp read them: in panels (gemm_tile.h), so
// that a block walks memory in a straight line.
#pragma once

#include "network/cpu/bfloat16_tile.h"
#include "network/cpu/gemm_tile.h"
#include "network/cpu/grouped_mlp_plan.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

VN_INLINE int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

VN_INLINE int64_t padded_width(const MlpPlanSource& source) {
  return (source.width + kGranule - 1) / kGranule * kGranule;
}

// Four rows of `from` become the four columns of `to`; by fours, since weights of small networks are packed often.
VN_INLINE void transpose_four(const float* from, int64_t from_stride, int64_t count, float* to, int64_t to_stride) {
  int64_t i = 0;
#if VN_ISA == 1 || VN_ISA == 2
  for (; i + 8 <= count; i += 8) {  // columns i and i + 4 side by side
    const __m256 a = _mm256_loadu_ps(from + i), b = _mm256_loadu_ps(from + from_stride + i);
    const __m256 c = _mm256_loadu_ps(from + 2 * from_stride + i), d = _mm256_loadu_ps(from + 3 * from_stride + i);
    const __m256 ab = _mm256_unpacklo_ps(a, b), cd = _mm256_unpacklo_ps(c, d);
    const __m256 ab_high = _mm256_unpackhi_ps(a, b), cd_high = _mm256_unpackhi_ps(c, d);
    const __m256 columns[] = {_mm256_shuffle_ps(ab, cd, 0x44), _mm256_shuffle_ps(ab, cd, 0xee),
                              _mm256_shuffle_ps(ab_high, cd_high, 0x44), _mm256_shuffle_ps(ab_high, cd_high, 0xee)};
    for (int64_t j = 0; j < 4; ++j) {
      _mm_storeu_ps(to + (i + j) * to_stride, _mm256_castps256_ps128(columns[j]));
      _mm_storeu_ps(to + (i + 4 + j) * to_stride, _mm256_extractf128_ps(columns[j], 1));
    }
  }
#elif VN_ISA == 3
  for (; i + 4 <= count; i += 4) {
    F32 rows[4];
    for (int row = 0; row < 4; ++row) rows[row] = load(from + row * from_stride + i);
    transpose(rows);
    for (int column = 0; column < 4; ++column) store(to + (i + column) * to_stride, rows[column]);
  }
#endif
  for (; i < count; ++i) {
    for (int64_t row = 0; row < 4; ++row) to[i * to_stride + row] = from[row * from_stride + i];
  }
}

// Weights [o][depth] -> [dots][depth], in pairs with bfloat16 operands, filled up with 0.
[[maybe_unused]] void pack_dots(const float* weights, const MlpPlanLayer& layer, float* packed) {
  for (int64_t o = 0; o < layer.dots; ++o, packed += layer.packed_depth) {
    for (int64_t i = 0; i < layer.packed_depth; i += kLanes) {
      if (o >= layer.width) {
        store(packed + i, splat(0.0f));
        continue;
      }
#if VN_HALF
      const float* from = weights + o * layer.depth + 2 * i;
      store(packed + i, joined(load(from), load(from + kLanes)));
#else
      store(packed + i, load(weights + o * layer.depth + i));
#endif
    }
  }
}

#if VN_HALF

// Weights [o][depth] -> panels [pairs of inputs][<= kPanel of o, padded to 16 with 0]; each source starts a pair. Rows
// are narrowed four at a time into `scratch`, then transposed, a pair being as wide as a float.
[[maybe_unused]] void pack_forward(const float* weights, const MlpPlanLayer& layer, float* packed, float* scratch) {
  const int64_t stride = layer.packed_depth + kGranule;
  for (int64_t first = 0; first < layer.padded; first += kPanel) {
    const int64_t columns = smaller(kPanel, layer.padded - first);
    for (int64_t column = 0; column < columns; column += 4) {
      for (int64_t row = 0; row < 4; ++row) {
        const int64_t o = first + column + row;
        float* pairs = scratch + row * stride;
        if (o >= layer.width) {
          for (int64_t i = 0; i < layer.packed_depth; ++i) pairs[i] = 0.0f;
          continue;
        }
        for (int64_t s = 0; s < layer.source_count; ++s) {
          const MlpPlanSource& source = layer.sources[s];
          narrow_row(weights + o * layer.depth + source.row, source.width, pairs + source.packed_row);
        }
      }
      transpose_four(scratch, stride, layer.packed_depth, packed + first * layer.packed_depth + column, columns);
    }
  }
}

// The inputs of one source: weights [o][depth] -> panels [pairs of o][<= kPanel of its width, padded to 16 with 0].
[[maybe_unused]] void pack_backward(const float* weights, const MlpPlanLayer& layer, const MlpPlanSource& source,
                                    float* packed) {
  const int64_t padded = padded_width(source);
  for (int64_t first = 0; first < padded; first += kPanel) {
    const int64_t columns = smaller(kPanel, padded - first);
    for (int64_t o = 0; o < layer.width; o += 2, packed += columns) {
      for (int64_t c = 0; c < columns; c += kGranule) {
        const int64_t count = smaller(kGranule, source.width - first - c);
        const float* from = weights + o * layer.depth + source.row + first + c;
        const F32 even = load_some(from, count);
        const F32 odd = o + 1 < layer.width ? load_some(from + layer.depth, count) : splat(0.0f);
        store(packed + c, interleave(even, odd));
      }
    }
  }
}

#else

// weights [o][depth] -> panels [depth][<= kPanel of o, padded to 16 with 0].
[[maybe_unused]] void pack_forward(const float* weights, const MlpPlanLayer& layer, float* packed, float*) {
  for (int64_t first = 0; first < layer.padded; first += kPanel) {
    const int64_t columns = smaller(kPanel, layer.padded - first);
    float* panel = packed + first * layer.depth;
    for (int64_t column = 0; column < columns; column += 4) {
      const int64_t o = first + column;
      if (o + 4 <= layer.width) {
        transpose_four(weights + o * layer.depth, layer.depth, layer.depth, panel + column, columns);
        continue;
      }
      for (int64_t i = 0; i < layer.depth; ++i) {
        for (int64_t c = 0; c < 4; ++c) {
          panel[i * columns + column + c] = o + c < layer.width ? weights[(o + c) * layer.depth + i] : 0.0f;
        }
      }
    }
  }
}

// The inputs of one source: weights [o][depth] -> panels [o][<= kPanel of its width, padded to 16 with 0].
[[maybe_unused]] void pack_backward(const float* weights, const MlpPlanLayer& layer, const MlpPlanSource& source,
                                    float* packed) {
  const int64_t padded = padded_width(source);
  for (int64_t first = 0; first < padded; first += kPanel) {
    const int64_t columns = smaller(kPanel, padded - first), count = smaller(columns, source.width - first);
    for (int64_t o = 0; o < layer.width; ++o) {
      const float* from = weights + o * layer.depth + source.row + first;
      for (int64_t c = 0; c < count; ++c) packed[c] = from[c];
      for (int64_t c = count; c < columns; ++c) packed[c] = 0.0f;
      packed += columns;
    }
  }
}

#endif

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
