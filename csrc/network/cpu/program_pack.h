// Parameters of a cell in panels (gemm_tile.h), the layout that the products read contiguously.
#pragma once

#include "encoding/frequency_encode_tile.h"
#include "network/cpu/program_isa.h"
#include "network/cpu/program_rows_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Transposes four rows of `from` to four columns of `to`. It is vectorised, since the weights of small networks are
// packed often.
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

VN_INLINE int64_t padded(int64_t width) { return (width + kGranule - 1) / kGranule * kGranule; }

// Returns the number of steps of a product along `depth`: floats, pairs of bfloat16, or pairs padded to whole tile
// registers.
VN_INLINE int64_t steps_of(int64_t depth) { return VN_HALF == 2 ? pairs_of(depth) : VN_HALF ? (depth + 1) / 2 : depth; }

// A matrix in memory. With `transposed`, the outputs of the product are contiguous, otherwise the depth is contiguous.
struct Matrix {
  const float* from;
  int64_t stride;  // from one row in memory to the next
  int64_t outputs, depth;
  bool transposed;

  float at(int64_t o, int64_t k) const { return transposed ? from[k * stride + o] : from[o * stride + k]; }
};

// Packs [outputs][depth] as [1 or 4][depth], padded with 0. The depth is a multiple of a vector.
[[maybe_unused]] void pack_few(const Matrix& m, float* to) {
  constexpr int64_t kStep = (VN_HALF ? 2 : 1) * kLanes;
  for (int64_t o = 0; o < (m.outputs == 1 ? 1 : 4); ++o) {
    for (int64_t k = 0; k < m.depth; k += kStep, to += kLanes) {
      float transposed[kStep] = {};
      const float* values = transposed;
      if (o < m.outputs && !m.transposed) values = m.from + o * m.stride + k;
      for (int64_t i = 0; o < m.outputs && m.transposed && i < kStep; ++i) transposed[i] = m.at(o, k + i);
#if VN_HALF
      store(to, joined(load(values), load(values + kLanes)));
#else
      store(to, load(values));
#endif
    }
  }
}

#if VN_HALF

// Packs a matrix as panels [pairs of depth][<= kPanel outputs, padded with 0]. With `parts`, a panel of rounding
// remainders follows each panel. Rows are narrowed into `free` four at a time and then transposed, with a pair treated
// as a float.
[[maybe_unused]] void pack_panels(const Matrix& m, float* to, float* free, bool parts) {
  const int64_t all = padded(m.outputs), depth = steps_of(m.depth);
  for (int64_t first = 0; first < all; first += kPanel) {
    const int64_t columns = all - first < kPanel ? all - first : kPanel, left = depth * columns;
    float* const panel = to + (parts ? 2 : 1) * first * depth;
    if (m.transposed) {
      for (int64_t k = 0; k < 2 * depth; k += 2) {
        for (int64_t c = 0; c < columns; c += kLanes) {
          const int64_t count = m.outputs - first - c;
          const float* from = m.from + k * m.stride + first + c;
          const F32 even = k < m.depth ? load_some(from, count) : splat(0.0f);
          const F32 odd = k + 1 < m.depth ? load_some(from + m.stride, count) : splat(0.0f);
          const F32 high = interleave(even, odd);
          store(panel + k / 2 * columns + c, high);
          if (parts) {
            store(panel + left + k / 2 * columns + c, interleave(even - lower_of(high), odd - upper_of(high)));
          }
        }
      }
      continue;
    }
    const int64_t stride = depth + kGranule;
    for (int64_t column = 0; column < columns; column += 4) {
      for (int64_t row = 0; row < 4; ++row) {
        const int64_t o = first + column + row;
        float *const pairs = free + row * stride, *const rest = pairs + 4 * stride;
        if (o < m.outputs) {
          narrow_row(m.from + o * m.stride, m.depth, pairs, parts ? rest : nullptr);
        } else {
          for (int64_t k = 0; k < depth; ++k) pairs[k] = rest[k] = 0.0f;
        }
      }
      transpose_four(free, stride, depth, panel + column, columns);
      if (parts) transpose_four(free + 4 * stride, stride, depth, panel + left + column, columns);
    }
  }
}

#else

// Packs a matrix as panels [depth][<= kPanel outputs, padded with 0].
[[maybe_unused]] void pack_panels(const Matrix& m, float* to, float*, bool) {
  const int64_t all = padded(m.outputs);
  for (int64_t first = 0; first < all; first += kPanel) {
    const int64_t columns = all - first < kPanel ? all - first : kPanel;
    const int64_t count = m.outputs - first < columns ? m.outputs - first : columns;
    float* const panel = to + first * m.depth;
    if (m.transposed) {
      for (int64_t k = 0; k < m.depth; ++k) {
        const float* row = m.from + k * m.stride + first;
        for (int64_t c = 0; c < count; ++c) panel[k * columns + c] = row[c];
        for (int64_t c = count; c < columns; ++c) panel[k * columns + c] = 0.0f;
      }
      continue;
    }
    for (int64_t column = 0; column < columns; column += 4) {
      const int64_t o = first + column;
      if (o + 4 <= m.outputs) {
        transpose_four(m.from + o * m.stride, m.stride, m.depth, panel + column, columns);
        continue;
      }
      for (int64_t k = 0; k < m.depth; ++k) {
        for (int64_t c = 0; c < 4; ++c) panel[k * columns + column + c] = o + c < m.outputs ? m.at(o + c, k) : 0.0f;
      }
    }
  }
}

#endif

[[maybe_unused]] void pack_cell(const CpuProgram& call, int64_t cell, bool first, float* packed, float* free) {
  for (int32_t p = 0; p < call.code.pack_count; ++p) {
    const ProgramPack& pack = call.code.packs[p];
    float* const to = packed + pack.at;
    if (pack.kind == ProgramPackKind::waves) {
      if (first) encode_table(to, pack.width, {pack.i, pack.o, pack.start != 0});
      continue;
    }
    const float* from =
        static_cast<const float*>(call.parameters[pack.parameter]) + cell * call.strides[pack.parameter] + pack.start;
    if (pack.kind == ProgramPackKind::vector) {
      copy_row(from, pack.width, to);
      for (int64_t c = pack.width; c < padded(pack.width); ++c) to[c] = 0.0f;
      continue;
    }
    const bool transposed = pack.kind == ProgramPackKind::transposed || pack.kind == ProgramPackKind::few_transposed;
    const bool few = pack.kind == ProgramPackKind::few || pack.kind == ProgramPackKind::few_transposed;
    const Matrix matrix{from, pack.i, transposed ? pack.width : pack.o, transposed ? pack.o : pack.width, transposed};
    if (few) {
      pack_few(matrix, to);
    } else {
      pack_panels(matrix, to, free, call.parts);
    }
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
