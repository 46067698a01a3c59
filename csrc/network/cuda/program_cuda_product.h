// Products on CUDA. TensorSteps and FloatSteps run the product steps of a program, with values in slots and weights
// packed by program_prepare_kernel. In a linear step a warp computes all columns of its rows, 64 at a time. Sums over
// rows are computed by the whole block.
//
// Tensor cores: weights are in the order of fragments. Each chunk of the depth and each tile of 8 columns has 16 bytes
// per lane, so a warp reads 512 contiguous bytes. 16-bit values are words of two columns. Their rows are 4 words longer
// than a multiple of 16, so the 8 rows of a matrix that ldmatrix reads are in different banks. The operand of the next
// step can stay in registers, since the accumulators of a product have the layout of a left operand.
//
// float32: a thread computes up to 8 rows by four columns, and weights are [depth][columns].
#pragma once

#include "common/cuda_wrappers.h"
#include "common/index_maps.h"
#include "network/cuda/program_cuda_tile.h"

namespace voronerf {

// Packed weights --------------------------------------------------------------------------------------------------

// A matrix of weights: at(depth, output) returns an element, or 0 outside. With `waves.octaves` > 0, the depth is in
// the order of an encoding's 16-bit numbers.
struct PackedMatrix {
  const float* data;
  int by_depth, by_output, depth, outputs;
  WaveOrder waves{};
  __device__ __forceinline__ float at(int k, int n) const {
    if (k >= depth || n >= outputs) return 0.0f;
    return data[(waves.octaves > 0 ? wave_column(waves, k) : k) * by_depth + n * by_output];
  }
};

// Returns word `word` of the fragments. Lane 4 g + m has, for column g of a tile, the depth indices that mma.sync
// assigns to member m of a group of four lanes.
template <typename Numbers>
__device__ __forceinline__ uint32_t packed_word(const PackedMatrix& matrix, int word) {
  const int tiles = padded(matrix.outputs, kProgramOutputs) / 8;
  const int part = word % 4, lane = word / 4 % 32, rest = word / 128, chunk = rest / tiles, tile = rest % tiles;
  return Numbers::right(matrix, Numbers::kChunk * chunk, part, lane % 4, 8 * tile + lane / 4);
}

// The bias of steps without a bias. As in packed biases, each column is stored twice.
alignas(16) static __device__ const float kNoBias[2 * kProgramWide] = {};

// Operands --------------------------------------------------------------------------------------------------------

// A value in its slot, as words of two 16-bit numbers or as floats.
struct ProductValue {
  const float* floats;
  const uint32_t* words;
  bool has_words;
  int stride;   // of the floats or the words
  int columns;  // floats after them are undefined, words are 0 up to a multiple of 32 columns
  __device__ __forceinline__ float at(int row, int column) const {
    return column < columns ? floats[row * stride + column] : 0.0f;
  }
};
// Returns a value from the slot of the block's first team (kFirst) or from the slot of the thread's team.
template <bool kFirst, typename Tile>
__device__ __forceinline__ ProductValue product_value(const Tile& tile, const CudaValue& value, bool words) {
  const float* at = (kFirst ? tile.first_slot(value.slot) : tile.slot(value.slot)) + value.start;
  return {at, reinterpret_cast<const uint32_t*>(at), words, value.stride, value.columns};
}

// A lane's part of a left operand: two fragments of mma.m16n8k16 for 16-bit [16][32], or the fragments of tf32
// [16][16].
struct LeftFragments {
  uint32_t words[2][4];
};

template <bool kBfloat16>
struct HalfNumbers {
  static constexpr int kChunk = 32;
  static constexpr bool kHalves = true, kCuts = !kBfloat16;  // kCuts: clamp to the largest number
  static constexpr auto kKind = kBfloat16 ? ProgramNumbers::bfloat16 : ProgramNumbers::float16;

  static __device__ __forceinline__ uint32_t pair(float x, float y) { return pack_halves<kBfloat16>(x, y); }
  static __device__ __forceinline__ uint32_t relu_pair(float x, float y) { return pack_relu<kBfloat16>(x, y); }
  static __device__ __forceinline__ uint32_t above_zero(uint32_t word) { return above_zero_halves<kBfloat16>(word); }
  static __device__ __forceinline__ uint32_t right(const PackedMatrix& matrix, int k, int part, int member, int n) {
    const int at = k + 8 * part + 2 * member;
    // Weights beyond the largest float16 are clamped.
    const uint32_t word = pair(matrix.at(at, n), matrix.at(at + 1, n));
    return kCuts ? clamp_halves(word) : word;
  }

  // Loads a left operand: rows from `row` on, depth from k on. If `cut`, infinite float16 operands are clamped.
  template <bool kShared, bool kWords>
  static __device__ __forceinline__ LeftFragments left(const ProductValue& x, int row, int k, bool cut, int lane) {
    LeftFragments result;
    if constexpr (kWords) {
#pragma unroll
      for (int s = 0; s < 2; ++s)
        load_matrices<kShared>(result.words[s], x.words + row * x.stride + k / 2 + 8 * s, x.stride, lane);
    } else {
      const int group = lane / 4, member = lane % 4;
#pragma unroll
      for (int i = 0; i < 8; ++i) {
        const int at = k + 16 * (i / 4) + 8 * (i % 4 / 2) + 2 * member, of = row + group + 8 * (i % 2);
        result.words[i / 4][i % 4] = pair(x.at(of, at), x.at(of, at + 1));
      }
    }
    if (kCuts && cut) clamp(result);
    return result;
  }
  static __device__ __forceinline__ void clamp(LeftFragments& result) {
#pragma unroll
    for (int i = 0; i < 8; ++i) result.words[i / 4][i % 4] = clamp_halves(result.words[i / 4][i % 4]);
  }
  static __device__ __forceinline__ void multiply(float (&sums)[4], const LeftFragments& left, const uint4& right) {
    const uint32_t first[2] = {right.x, right.y}, second[2] = {right.z, right.w};
    multiply_halves<kBfloat16>(sums, left.words[0], first);
    multiply_halves<kBfloat16>(sums, left.words[1], second);
  }

  // Loads a transposed left operand for sums over rows: columns from i on become its rows, and the 16 rows from `row`
  // on become its depth. kWhole: the value is in words.
  static constexpr int kRows = 16;
  template <bool kShared, bool kWhole>
  static __device__ __forceinline__ void transposed_left(uint32_t (&words)[4], const ProductValue& a, int i, int row,
                                                         int rows, int lane) {
    if (kWhole || a.has_words) {
      load_transposed<kShared, true>(words, a.words + row * a.stride + i / 2, a.stride, lane);
    } else {
#pragma unroll
      for (int j = 0; j < 4; ++j) words[j] = transposed_pair(a, row + 8 * (j / 2), i + 8 * (j % 2), rows, lane);
    }
  }
  // Loads columns from j on, two tiles of 8, as right operands.
  template <bool kShared, bool kWhole>
  static __device__ __forceinline__ void transposed_right(uint32_t (&words)[2][2], const ProductValue& b, int j,
                                                          int row, int rows, bool cut, int lane) {
    if (kWhole || b.has_words) {
      uint32_t four[4];
      load_transposed<kShared, false>(four, b.words + row * b.stride + j / 2, b.stride, lane);
#pragma unroll
      for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = four[i];
    } else {
#pragma unroll
      for (int i = 0; i < 4; ++i)
        words[i / 2][i % 2] = transposed_pair(b, row + 8 * (i % 2), j + 8 * (i / 2), rows, lane);
    }
    if (kCuts && cut) {
#pragma unroll
      for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = clamp_halves(words[i / 2][i % 2]);
    }
  }
  static __device__ __forceinline__ void multiply_transposed(float (&sums)[4], const uint32_t (&left)[4],
                                                             const uint32_t (&right)[2]) {
    multiply_halves<kBfloat16>(sums, left, right);
  }

 private:
  // Returns two rows of a lane's column as a pair.
  static __device__ __forceinline__ uint32_t transposed_pair(const ProductValue& a, int row, int column, int rows,
                                                             int lane) {
    const int at = row + 2 * (lane % 4), of = column + lane / 4;
    return pair(at < rows ? a.at(at, of) : 0.0f, at + 1 < rows ? a.at(at + 1, of) : 0.0f);
  }
};

struct Tf32Numbers {
  static constexpr int kChunk = 16;
  static constexpr bool kHalves = false, kCuts = false;
  static constexpr auto kKind = ProgramNumbers::floats;

  static __device__ __forceinline__ uint32_t word(float x) {
    const float rounded = round_to_tf32(x);
    uint32_t bits;
    memcpy(&bits, &rounded, sizeof bits);
    return bits;
  }
  static __device__ __forceinline__ uint32_t pair(float, float) { return 0; }  // unused: values are floats
  static __device__ __forceinline__ uint32_t relu_pair(float, float) { return 0; }
  static __device__ __forceinline__ uint32_t above_zero(uint32_t) { return 0; }
  static __device__ __forceinline__ uint32_t right(const PackedMatrix& matrix, int k, int part, int member, int n) {
    return word(matrix.at(k + 4 * part + member, n));
  }
  template <bool kShared, bool kWords>
  static __device__ __forceinline__ LeftFragments left(const ProductValue& x, int row, int k, bool, int lane) {
    const int group = lane / 4, member = lane % 4;
    LeftFragments result;
#pragma unroll
    for (int i = 0; i < 8; ++i) {
      result.words[i / 4][i % 4] = word(x.at(row + group + 8 * (i % 2), k + 8 * (i / 4) + 4 * (i % 4 / 2) + member));
    }
    return result;
  }
  static __device__ __forceinline__ void clamp(LeftFragments&) {}
  static __device__ __forceinline__ void multiply(float (&sums)[4], const LeftFragments& left, const uint4& right) {
    const uint32_t first[2] = {right.x, right.y}, second[2] = {right.z, right.w};
    multiply_tf32(sums, left.words[0], first);
    multiply_tf32(sums, left.words[1], second);
  }

  // Member m of a group of four lanes takes rows 2 m and 2 m + 1, not m and m + 4, so that the 32 lanes of a warp read
  // different banks.
  static constexpr int kRows = 8;
  template <bool kShared, bool kWhole>
  static __device__ __forceinline__ void transposed_left(uint32_t (&words)[4], const ProductValue& a, int i, int row,
                                                         int rows, int lane) {
#pragma unroll
    for (int j = 0; j < 4; ++j) words[j] = transposed<kWhole>(a, row + j / 2, i + 8 * (j % 2), rows, lane);
  }
  template <bool kShared, bool kWhole>
  static __device__ __forceinline__ void transposed_right(uint32_t (&words)[2][2], const ProductValue& b, int j,
                                                          int row, int rows, bool, int lane) {
#pragma unroll
    for (int i = 0; i < 4; ++i) words[i / 2][i % 2] = transposed<kWhole>(b, row + i % 2, j + 8 * (i / 2), rows, lane);
  }
  static __device__ __forceinline__ void multiply_transposed(float (&sums)[4], const uint32_t (&left)[4],
                                                             const uint32_t (&right)[2]) {
    multiply_tf32(sums, left, right);
  }

 private:
  template <bool kWhole>
  static __device__ __forceinline__ uint32_t transposed(const ProductValue& a, int row, int column, int rows,
                                                        int lane) {
    const int at = row + 2 * (lane % 4), of = column + lane / 4;
    if (kWhole) return word(a.floats[at * a.stride + of]);
    return word(at < rows ? a.at(at, of) : 0.0f);
  }
};

// Steps -----------------------------------------------------------------------------------------------------------

// A value of up to 64 columns that a warp holds in registers between steps. The words of a product's result are
// fragments of the next product. For each tile of 8 columns, a lane has its words of rows g and g + 8.
template <int kTall>
struct HeldWords {
  uint32_t words[kTall][kProgramWide / 8][2];
  // Returns columns 32 c to 32 c + 31 of rows 16 r to 16 r + 15 as a left operand.
  __device__ __forceinline__ LeftFragments left(int r, int c) const {
    LeftFragments result;
#pragma unroll
    for (int i = 0; i < 8; ++i) result.words[i / 4][i % 4] = words[r][4 * c + i / 2][i % 2];
    return result;
  }
};

// The product steps on tensor cores. A team has 16 kTall rows and kTeam warps. kShared: slots are in shared memory.
//
// Operands of float16 products are clamped to the largest number, since infinities in a network soon become NaN.
// Gradients are not clamped, because loss scaling checks them for infinities. The operand that is multiplied by a
// transposed matrix is assumed to be a gradient.
template <typename Numbers, int kTall, int kTeam, bool kShared>
struct TensorSteps {
  using Tile = ProgramTile<16 * kTall, kTeam, kShared, Numbers::kKind>;
  using Held = HeldWords<kTall>;

  // Runs any linear step. If the next steps add to its sums, it runs them too and advances `number` to the last of
  // them. In a team each warp has 16 of 64 columns, except for values in registers, which only the first warp computes.
  static __device__ __forceinline__ void linear(const Tile& tile, CudaStep& step, int& number, Held& held) {
    const bool words = Numbers::kHalves && (step.pairs >= 0 || step.is(kHolds) || step.is(kCarries));
    const int wide = words ? 2 * pair_words(step.width) : step.width;
    if (kTeam > 1 && !in_registers(step)) {
#pragma unroll 1
      for (int first = 16 * Tile::warp(); first < wide; first += 16 * kTeam) part<2>(tile, step, number, first, held);
      return;
    }
    if (kTeam > 1 && Tile::warp() > 0) {
      while (step.is(kCarries)) step = load_step(tile.call.steps + ++number);
      return;
    }
    if (wide <= 8) return part<1>(tile, step, number, 0, held);
#pragma unroll 1
    for (int first = 0; first < wide; first += kProgramWide) {
      if (wide - first > kProgramWide / 2) {
        part<8>(tile, step, number, first, held);
      } else {
        part<4>(tile, step, number, first, held);
      }
    }
  }

  // Runs a step of a chain of layers, from words to words. The code is separate for each way to read the operand, since
  // in shared code the compiler would move sums between registers.
  static __device__ __forceinline__ void chained(const Tile& tile, const CudaStep& step, Held& held) {
    if constexpr (Numbers::kHalves) {
      const int width = step.width, half = kProgramWide / 2;
      if (kTeam > 1 && !in_registers(step)) {
#pragma unroll 1
        for (int first = 16 * Tile::warp(); first < 2 * pair_words(width); first += 16 * kTeam) {
          chained_part<2, 0>(tile, step, first, held);
        }
        return;
      }
      if (kTeam > 1 && Tile::warp() > 0) return;
      if (step.is(kXHeld) && width > half) {
        if (step.depth > half) return chained_part<8, 2>(tile, step, 0, held);
        return chained_part<8, 1>(tile, step, 0, held);
      }
      if (step.is(kXHeld)) {
        if (step.depth > half) return chained_part<4, 2>(tile, step, 0, held);
        return chained_part<4, 1>(tile, step, 0, held);
      }
#pragma unroll 1
      for (int first = 0; first < width; first += kProgramWide) {
        if (width - first > half) {
          chained_part<8, 0>(tile, step, first, held);
        } else {
          chained_part<4, 0>(tile, step, first, held);
        }
      }
    }
  }

  // Computes partial[i][j] += sum over rows of a[row][i] b[row][j]. A warp computes 16 by 32 entries at a time. If
  // step.bias >= 0, warps with a's first 16 columns also add up the columns of b.
  static __device__ __forceinline__ void outer(const Tile& tile, const CudaStep& step) {
    const ProductValue a = product_value<true>(tile, step.x, step.is(kXWords));
    const ProductValue b = product_value<true>(tile, step.y, step.is(kYWords));
    const bool words = Numbers::kHalves && a.has_words && b.has_words;
    const int down = padded(a.columns, 16);
    int i0 = 16 * static_cast<int>(thread_again() / 32), j0 = 0;
#pragma unroll 1
    for (;; i0 += static_cast<int>(threads_again() / 2)) {
      for (; i0 >= down; j0 += 32) i0 -= down;  // a division takes longer
      if (j0 >= b.columns) break;
      if (words) {
        outer_block<Numbers::kHalves>(tile, step, a, b, i0, j0);
      } else {
        outer_block<false>(tile, step, a, b, i0, j0);
      }
    }
  }

  // Computes partial[j] += sum over rows of b[row][j]; for words, by a product with ones.
  static __device__ __forceinline__ void columns(const Tile& tile, const CudaStep& step) {
    if constexpr (Numbers::kHalves) {
      if (step.is(kXWords)) return sum_words(tile, step);
    }
    sum_columns(tile, step);
  }

 private:
  template <int kTiles>
  using Sums = float[kTall][kTiles][4];

  // Computes 16 by 32 entries of an outer product. kWords: of words, whose padding is 0; the partial has space for it.
  template <bool kWords>
  static __device__ __forceinline__ void outer_block(const Tile& tile, const CudaStep& step, const ProductValue& a,
                                                     const ProductValue& b, int i0, int j0) {
    const int lane = lane_again();
    const bool fill = tile.fill(), swapped = step.is(kSwapped);
    const bool whole = kWords || (i0 + 16 <= a.columns && j0 + 32 <= b.columns);
    float* const partial = tile.partial() + step.number;
    float* const corner = partial + (i0 + lane / 4) * step.stride + j0 + 2 * (lane % 4);
    const auto entries = [&](int t) { return reinterpret_cast<float2*>(corner + t % 2 * 8 * step.stride + t / 2 * 8); };
    float2 previous[8];  // loaded while the products run
#pragma unroll
    for (int t = 0; t < 8; ++t) previous[t] = whole && !fill ? *entries(t) : make_float2(0.0f, 0.0f);
    float sums[4][4] = {};
    // The padding after the columns of a row only affects sums that are not stored.
    const bool floats = !Numbers::kHalves && tile.all() % Tile::kRows == 0 && step.x.start + i0 + 16 <= step.x.stride &&
                        step.y.start + j0 + 32 <= step.y.stride;
    if (kWords && step.bias >= 0 && i0 == 0) {
      float columns[4][4] = {};
      multiply_transposed<true, true>(sums, columns, tile, a, b, i0, j0, swapped, lane);
      add_columns(columns, tile.partial() + step.bias + j0, fill, lane);
    } else if (kWords || floats) {
      multiply_transposed<true, false>(sums, sums, tile, a, b, i0, j0, swapped, lane);
    } else {
      multiply_transposed<false, false>(sums, sums, tile, a, b, i0, j0, swapped, lane);
    }
    if constexpr (!kWords) {
      if (!whole) {
#pragma unroll
        for (int i = 0; i < 16; ++i) {
          const MapPlace at = accumulator_place(static_cast<unsigned>(lane), i % 4);
          const int from = i0 + at.row, to = j0 + i / 4 * 8 + at.column;
          if (from >= a.columns || to >= b.columns) continue;
          float& entry = partial[from * step.stride + to];
          entry = (fill ? 0.0f : entry) + sums[i / 4][i % 4];
        }
        return;
      }
    }
#pragma unroll
    for (int t = 0; t < 8; ++t) {
      const float x = sums[t / 2][t % 2 * 2] + previous[t].x, y = sums[t / 2][t % 2 * 2 + 1] + previous[t].y;
      *entries(t) = make_float2(x, y);
    }
  }

  static __device__ __forceinline__ bool in_registers(const CudaStep& step) {
    return step.is(kXHeld) || step.is(kHolds) || step.is(kCarries);
  }

  // Computes 8 kTiles columns from `first` on. kHeld: the number of chunks of an operand in registers, or 0 if the
  // operand is in its slot.
  template <int kTiles, int kHeld>
  static __device__ __forceinline__ void chained_part(const Tile& tile, const CudaStep& step, int first, Held& held) {
    const int lane = lane_again();
    Sums<kTiles> sums;
    const Product product{tile, step, first, lane};
    product.start(sums);
    if constexpr (kHeld > 0) {
#pragma unroll
      for (int c = 0; c < kHeld; ++c) product.chunk(sums, c, [&](int r) { return product.held(held, r, c); });
    } else {
      const int chunks = ceil_div(step.depth, Numbers::kChunk);
      // The first chunk is apart: its products read the bias of both rows from the same registers.
      product.chunk(sums, 0, [&](int r) { return product.template left<true>(r, 0); });
#pragma unroll 1
      for (int c = 1; c < chunks; ++c) product.chunk(sums, c, [&](int r) { return product.template left<true>(r, c); });
    }
    put_words<kTiles>(held, sums, tile, step, first);
  }
  // Computes 8 kTiles columns from `first` on for any linear step.
  template <int kTiles>
  static __device__ __forceinline__ void part(const Tile& tile, CudaStep& step, int& number, int first, Held& held) {
    const int lane = lane_again();
    Sums<kTiles> sums;
    Product{tile, step, first, lane}.start(sums);
#pragma unroll 1
    for (;;) {
      multiply<kTiles>(sums, tile, step, first, held, lane);
      if (step.added >= 0) add<kTiles>(sums, step, tile, first);
      if (!Numbers::kHalves || kTiles == 1 || !step.is(kCarries)) break;
      step = load_step(tile.call.steps + ++number);
    }
    const bool floats = step.slot >= 0, by_words = Numbers::kHalves && step.is(kYWords);
    if (step.is(kRelu) && floats) {
      for_each_sum<kTiles>([&](int r, int t, int i) { sums[r][t][i] = sums[r][t][i] < 0.0f ? 0.0f : sums[r][t][i]; });
    }
    if (step.is(kSloped) && (floats || !by_words)) cut_slopes<kTiles>(sums, tile, step, first);
    if (floats && tile.rows() == Tile::kRows && first + 8 * kTiles <= step.width) {
      store<kTiles, true>(sums, tile, step, first);
    } else if (floats) {
      store<kTiles, false>(sums, tile, step, first);
    }
    // Words are made even if no step reads them: otherwise the previously held value would occupy registers besides the
    // sums. Overwriting it is safe, since a value in registers has at most 64 columns, so no other part needs the
    // previous value.
    if constexpr (kTiles > 1 && Numbers::kHalves) put_words<kTiles>(held, sums, tile, step, first);
  }

  template <int kTiles, typename Visit>
  static __device__ __forceinline__ void for_each_sum(const Visit& visit) {
#pragma unroll
    for (int i = 0; i < 4 * kTall * kTiles; ++i) visit(i / (4 * kTiles), i / 4 % kTiles, i % 4);
  }
  template <int kTiles, typename Visit>
  static __device__ __forceinline__ void for_each_word(const Visit& visit) {
#pragma unroll
    for (int i = 0; i < 2 * kTall * kTiles; ++i) visit(i / (2 * kTiles), i / 2 % kTiles, i % 2);
  }
  // Calls visit(r, t) for each block of 16 rows by 16 columns: tiles t and t + 1.
  template <int kTiles, typename Visit>
  static __device__ __forceinline__ void for_each_block(const Visit& visit) {
    static_assert(kTiles % 2 == 0);
#pragma unroll
    for (int i = 0; i < kTall * kTiles / 2; ++i) visit(2 * i / kTiles, 2 * i % kTiles);
  }
  // Returns the row and column of a sum, relative to the rows of its warp and the columns of its part.
  static __device__ __forceinline__ MapPlace place(int r, int t, int i, int lane) {
    const MapPlace offset = accumulator_place(static_cast<unsigned>(lane), i);
    return {16 * r + offset.row, 8 * t + offset.column};
  }

  // A lane's part of the product x w^T + bias, for columns from `first` on.
  struct Product {
    ProductValue x;
    const uint4* weights;
    const float4* bias;
    int across, lane;
    bool cut;
    __device__ __forceinline__ Product(const Tile& tile, const CudaStep& step, int first, int lane)
        : x(product_value<false>(tile, step.x, step.is(kXWords))),
          weights(reinterpret_cast<const uint4*>(tile.packed(step.weights)) + first / 8 * 32 + lane),
          bias(reinterpret_cast<const float4*>(step.bias < 0 ? kNoBias : tile.packed(step.bias) + 2 * first) +
               lane % 4),
          across(4 * padded(step.width, kProgramOutputs)),
          lane(lane),
          cut(!step.is(kTransposed)) {}
    // Sets the sums to the bias.
    template <int kTiles>
    __device__ __forceinline__ void start(float (&sums)[kTall][kTiles][4]) const {
#pragma unroll
      for (int t = 0; t < kTiles; ++t) {
        const float4 four = load_constant(bias + 4 * t);
#pragma unroll
        for (int r = 0; r < kTall; ++r) {
          sums[r][t][0] = four.x, sums[r][t][1] = four.y, sums[r][t][2] = four.z, sums[r][t][3] = four.w;
        }
      }
    }
    // held and left return a left operand of 16 rows, from registers or from its slot.
    __device__ __forceinline__ LeftFragments held(const Held& held, int r, int c) const {
      LeftFragments left = held.left(r, c);
      if (Numbers::kCuts && cut) Numbers::clamp(left);
      return left;
    }
    template <bool kWords>
    __device__ __forceinline__ LeftFragments left(int r, int c) const {
      return Numbers::template left<kShared, kWords>(x, 16 * r, Numbers::kChunk * c, cut, lane);
    }
    // Adds the product of one chunk of the depth to the sums. left(r) returns the left operand of 16 rows.
    template <int kTiles, typename Left>
    __device__ __forceinline__ void chunk(float (&sums)[kTall][kTiles][4], int c, const Left& left) const {
      const uint4* const from = weights + c * across;
      LeftFragments fragments[kTall];
#pragma unroll
      for (int r = 0; r < kTall; ++r) fragments[r] = left(r);
#pragma unroll
      for (int t = 0; t < kTiles; ++t) {
        const uint4 right = load_constant(from + 32 * t);
#pragma unroll
        for (int r = 0; r < kTall; ++r) Numbers::multiply(sums[r][t], fragments[r], right);
      }
    }
  };
  // Adds x w^T to the sums.
  template <int kTiles>
  static __device__ __forceinline__ void multiply(Sums<kTiles>& sums, const Tile& tile, const CudaStep& step, int first,
                                                  const Held& held, int lane) {
    const Product product{tile, step, first, lane};
    const int chunks = ceil_div(step.depth, Numbers::kChunk);
    if (Numbers::kHalves && step.is(kXHeld)) {
      product.chunk(sums, 0, [&](int r) { return product.held(held, r, 0); });
      if (chunks > 1) product.chunk(sums, 1, [&](int r) { return product.held(held, r, 1); });
      return;
    }
    const bool words = Numbers::kHalves && step.is(kXWords);
#pragma unroll 1
    for (int c = 0; c < chunks; ++c) {
      product.chunk(sums, c, [&](int r) {
        return words ? product.template left<Numbers::kHalves>(r, c) : product.template left<false>(r, c);
      });
    }
  }

  // Goes through the block's rows, which are the depth of a sum over rows, and calls visit(a, b, row, rows) for each
  // piece of Numbers::kRows rows. a and b begin at the first row of the piece's team, and `row` is the piece's first
  // row within the team. `rows` is the number of rows with a sample in this team and all later ones.
  template <bool kWhole, typename Visit>
  static __device__ __forceinline__ void for_each_depth(const Tile& tile, ProductValue a, ProductValue b,
                                                        const Visit& visit) {
#pragma unroll(!kWhole || !kShared ? 1 : Numbers::kRows / 4 / kTall)
    for (int left = tile.all(); left > 0; left -= Tile::kRows) {
#pragma unroll
      for (int row = 0; row < Tile::kRows; row += Numbers::kRows) visit(a, b, row, left);
      a.floats += tile.pitch(), a.words += tile.pitch();
      b.floats += tile.pitch(), b.words += tile.pitch();
    }
  }

  // Adds the product, over rows, of a's 16 columns from i0 on and b's 32 columns from j0 on to the sums. kWhole: no
  // bounds checks are needed. Both operands are words, padded with 0 in rows and columns, or floats whose rows are long
  // enough and all have a sample. kColumns: also adds the sum of b over rows to `columns`.
  template <bool kWhole, bool kColumns>
  static __device__ __forceinline__ void multiply_transposed(float (&sums)[4][4], float (&columns)[4][4],
                                                             const Tile& tile, const ProductValue& a,
                                                             const ProductValue& b, int i0, int j0, bool swapped,
                                                             int lane) {
    const int tiles = ceil_div(b.columns - j0, 8);
    for_each_depth<kWhole>(tile, a, b, [&](const ProductValue& x, const ProductValue& y, int row, int rows) {
      uint32_t left[4];
      Numbers::template transposed_left<kShared, kWhole>(left, x, i0, row, rows, lane);
      if constexpr (Numbers::kCuts) {
        for (uint32_t& word : left) word = swapped ? clamp_halves(word) : word;
      }
#pragma unroll
      for (int pair = 0; pair < 2; ++pair) {
        if (!kWhole && 2 * pair >= tiles) continue;
        uint32_t right[2][2];
        Numbers::template transposed_right<kShared, kWhole>(right, y, j0 + 16 * pair, row, rows, !swapped, lane);
        Numbers::multiply_transposed(sums[2 * pair], left, right[0]);
        Numbers::multiply_transposed(sums[2 * pair + 1], left, right[1]);
        if constexpr (kColumns) {
          add_ones(columns[2 * pair], right[0]);
          add_ones(columns[2 * pair + 1], right[1]);
        }
      }
    });
  }

  static __device__ __forceinline__ void sum_words(const Tile& tile, const CudaStep& step) {
    const ProductValue b = product_value<true>(tile, step.x, true);
    const int lane = lane_again(), across = static_cast<int>(threads_again() / 2);
    const bool fill = tile.fill();
#pragma unroll 1
    for (int j0 = 16 * static_cast<int>(thread_again() / 32); j0 < step.width; j0 += across) {
      float sums[2][4] = {};
      for_each_depth<true>(tile, b, b, [&](const ProductValue&, const ProductValue& own, int row, int rows) {
        uint32_t right[2][2];
        Numbers::template transposed_right<kShared, true>(right, own, j0, row, rows, false, lane);
        add_ones(sums[0], right[0]);
        add_ones(sums[1], right[1]);
      });
      add_columns(sums, tile.partial() + step.number + j0, fill, lane);
    }
  }
  // Adds sums of columns over the rows, by a product with ones.
  static __device__ __forceinline__ void add_ones(float (&sums)[4], const uint32_t (&right)[2]) {
    const uint32_t one = Numbers::pair(1.0f, 1.0f), ones[4] = {one, one, one, one};
    Numbers::multiply_transposed(sums, ones, right);
  }
  // Adds sums of columns to the partial, which has space for all columns of the tiles of eight.
  template <int kTiles>
  static __device__ __forceinline__ void add_columns(const float (&sums)[kTiles][4], float* partial, bool fill,
                                                     int lane) {
    if (lane >= 4) return;
    float2* const entries = reinterpret_cast<float2*>(partial) + lane;
    float2 previous[kTiles];
#pragma unroll
    for (int t = 0; t < kTiles; ++t) previous[t] = fill ? make_float2(0.0f, 0.0f) : entries[4 * t];
#pragma unroll
    for (int t = 0; t < kTiles; ++t) {
      entries[4 * t] = make_float2(previous[t].x + sums[t][0], previous[t].y + sums[t][1]);
    }
  }

  // Adds the step's added operand (step.added) to the sums.
  template <int kTiles>
  static __device__ __forceinline__ void add(Sums<kTiles>& sums, const CudaStep& step, const Tile& tile, int first) {
    const int lane = lane_again(), rows = tile.rows();
    const Operand added = tile.operand(tile.call.code.operands[step.added]);
    for_each_sum<kTiles>([&](int r, int t, int i) {
      const MapPlace at = place(r, t, i, lane);
      const bool inside = at.row < rows && first + at.column < step.width;
      if (inside) sums[r][t][i] += added.at(at.row, first + at.column);
    });
  }

  // Sets sums to 0 where the value of the ReLU is 0 or less.
  template <int kTiles>
  static __device__ __forceinline__ void cut_slopes(Sums<kTiles>& sums, const Tile& tile, const CudaStep& step,
                                                    int first) {
    const int lane = lane_again();
    const ProductValue slope = product_value<false>(tile, step.y, step.is(kYWords));
    if (Numbers::kHalves && slope.has_words) {
      const uint32_t* corner = slope.words + lane / 4 * slope.stride + first / 2 + lane % 4;
      for_each_sum<kTiles>([&](int r, int t, int i) {
        const uint32_t above = Numbers::above_zero(corner[(16 * r + i / 2 * 8) * slope.stride + 4 * t]);
        sums[r][t][i] = (i % 2 == 0 ? above & 1u : above >> 31) != 0 ? sums[r][t][i] : 0.0f;
      });
      return;
    }
    for_each_sum<kTiles>([&](int r, int t, int i) {
      const MapPlace at = place(r, t, i, lane);
      const bool cut = slope.at(at.row, first + at.column) <= 0.0f;  // false for NaN
      sums[r][t][i] = cut ? 0.0f : sums[r][t][i];
    });
  }

  // Rounds the value to words, keeps them in registers and stores them to their slot, if any.
  template <int kTiles>
  static __device__ __forceinline__ void put_words(Held& held, const Sums<kTiles>& sums, const Tile& tile,
                                                   const CudaStep& step, int first) {
    const int lane = lane_again();
    if (step.is(kRelu)) {
      for_each_word<kTiles>([&](int r, int t, int h) {
        held.words[r][t][h] = Numbers::relu_pair(sums[r][t][2 * h], sums[r][t][2 * h + 1]);
      });
    } else {
      for_each_word<kTiles>(
          [&](int r, int t, int h) { held.words[r][t][h] = Numbers::pair(sums[r][t][2 * h], sums[r][t][2 * h + 1]); });
    }
    if (step.is(kSloped) && step.is(kYWords)) {
      const uint32_t* const corner = product_value<false>(tile, step.y, true).words + first / 2;
      for_each_block<kTiles>([&](int r, int t) {
        uint32_t slopes[4];
        load_matrices<kShared>(slopes, corner + 16 * r * step.y.stride + 4 * t, step.y.stride, lane);
#pragma unroll
        for (int i = 0; i < 4; ++i) held.words[r][t + i / 2][i % 2] &= Numbers::above_zero(slopes[i]);
      });
    }
    if (tile.rows() < Tile::kRows || first + 8 * kTiles > step.width) {
      clear_outside<kTiles>(held, tile, step.width - first, lane);
    }
    if (step.pairs < 0) return;
    const int stride = pair_stride(step.width);
    uint32_t* const to = reinterpret_cast<uint32_t*>(tile.slot(step.pairs)) + first / 2;
    for_each_block<kTiles>([&](int r, int t) {
      const auto& words = held.words[r];
      const uint32_t four[4] = {words[t][0], words[t][1], words[t + 1][0], words[t + 1][1]};
      store_matrices<kShared>(to + 16 * r * stride + 4 * t, four, stride, lane);
    });
  }
  // Clears the numbers in rows without a sample and in columns after the last one, since products read multiples of 16
  // rows and columns.
  template <int kTiles>
  static __device__ __forceinline__ void clear_outside(Held& held, const Tile& tile, int columns, int lane) {
    const int rows = tile.rows();
    for_each_word<kTiles>([&](int r, int t, int h) {
      const MapPlace at = place(r, t, 2 * h, lane);
      const int left = at.row < rows ? columns - at.column : 0;
      held.words[r][t][h] &= left > 1 ? 0xffffffffu : left > 0 ? 0xffffu : 0u;
    });
  }

  // Stores the sums as floats. kWhole: every row has a sample and every sum a column.
  template <int kTiles, bool kWhole>
  static __device__ __forceinline__ void store(const Sums<kTiles>& sums, const Tile& tile, const CudaStep& step,
                                               int first) {
    const int lane = lane_again(), rows = tile.rows();
    float* const floats = tile.slot(step.slot);
    const int stride = step.stride, width = step.width;
    for_each_sum<kTiles>([&](int r, int t, int i) {
      if (i % 2 == 1) return;
      const MapPlace at = place(r, t, i, lane);
      const int column = first + at.column;
      float* const to = floats + at.row * stride + column;
      if (!kWhole && (at.row >= rows || column >= width)) return;
      if (kWhole || column + 1 < width) {
        *reinterpret_cast<float2*>(to) = make_float2(sums[r][t][i], sums[r][t][i + 1]);
      } else {
        *to = sums[r][t][i];
      }
    });
  }
};

// The product steps in float32. A team has 16 rows.
template <int kTeam, bool kShared>
struct FloatSteps {
  using Tile = ProgramTile<16, kTeam, kShared, ProgramNumbers::floats>;
  struct Held {};

  static __device__ __forceinline__ void chained(const Tile&, const CudaStep&, Held&) {}
  static __device__ __forceinline__ void linear(const Tile& tile, const CudaStep& step, int&, Held&) {
    const int worker = Tile::worker();
    if (step.width > 16) {
#pragma unroll 1
      for (int first = 4 * (worker % 16); first < step.width; first += kProgramWide) {
        block<8 / kTeam>(tile, step, worker / 16, first);
      }
    } else if (step.width > 4) {
      const int first = 4 * (worker % 4), row = worker / 4;
      if (first < step.width && row < Tile::kRows) block<kTeam == 1 ? 2 : 1>(tile, step, row, first);
    } else if (worker < Tile::kRows) {
      block<1>(tile, step, worker, 0);
    }
  }

  // Computes the same sums as TensorSteps::outer. A thread computes 4 by 4 entries at a time.
  static __device__ __forceinline__ void outer(const Tile& tile, const CudaStep& step) {
    const ProductValue a = product_value<true>(tile, step.x, false), b = product_value<true>(tile, step.y, false);
    const bool whole = (step.x.start | step.x.stride | step.y.start | step.y.stride) % 4 == 0;
    const int across = ceil_div(b.columns, 4), units = ceil_div(a.columns, 4) * across, all = tile.all();
    const bool fill = tile.fill();
#pragma unroll 1
    for (int unit = static_cast<int>(thread_again()); unit < units; unit += static_cast<int>(threads_again())) {
      const int i0 = 4 * (unit / across), j0 = 4 * (unit % across);
      float4 sums[4] = {};
      ProductValue x = a, y = b;
#pragma unroll 1
      for (int left = all; left > 0; left -= Tile::kRows, x.floats += tile.pitch(), y.floats += tile.pitch()) {
        const int rows = left < Tile::kRows ? left : Tile::kRows;
        if (whole) {
#pragma unroll 4
          for (int row = 0; row < rows; ++row) {
            const float4 four = *reinterpret_cast<const float4*>(x.floats + row * x.stride + i0);
            const float4 by = *reinterpret_cast<const float4*>(y.floats + row * y.stride + j0);
            accumulate(sums[0], four.x, by);
            accumulate(sums[1], four.y, by);
            accumulate(sums[2], four.z, by);
            accumulate(sums[3], four.w, by);
          }
        } else {
#pragma unroll 1
          for (int row = 0; row < rows; ++row) {
            const float4 by = make_float4(y.at(row, j0), y.at(row, j0 + 1), y.at(row, j0 + 2), y.at(row, j0 + 3));
#pragma unroll
            for (int i = 0; i < 4; ++i) accumulate(sums[i], x.at(row, i0 + i), by);
          }
        }
      }
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        if (i0 + i >= a.columns) continue;
        float* const at = tile.partial() + step.number + (i0 + i) * step.stride + j0;
        if (j0 + 4 <= b.columns) {
          float4 entry = fill ? make_float4(0.0f, 0.0f, 0.0f, 0.0f) : *reinterpret_cast<float4*>(at);
          entry.x += sums[i].x, entry.y += sums[i].y, entry.z += sums[i].z, entry.w += sums[i].w;
          *reinterpret_cast<float4*>(at) = entry;
          continue;
        }
        const float three[3] = {sums[i].x, sums[i].y, sums[i].z};
#pragma unroll
        for (int j = 0; j < 3; ++j) {
          if (j0 + j < b.columns) at[j] = (fill ? 0.0f : at[j]) + three[j];
        }
      }
    }
  }

  static __device__ __forceinline__ void columns(const Tile& tile, const CudaStep& step) { sum_columns(tile, step); }

 private:
  // Computes kRows rows from `row` on, kApart apart, by four columns.
  template <int kRows>
  static __device__ __forceinline__ void block(const Tile& tile, const CudaStep& step, int row, int first) {
    constexpr int kApart = Tile::kRows / kRows;
    const ProductValue value = product_value<false>(tile, step.x, false);
    const int stride = padded(step.width, kProgramOutputs), down = kApart * value.stride, depth = step.depth;
    const int samples = tile.rows();
    const float* const x = value.floats + row * value.stride;
    float4 sums[kRows] = {};
    if (step.bias >= 0) {
      const float4 four = load_constant(reinterpret_cast<const float4*>(tile.packed(step.bias) + first));
#pragma unroll
      for (int r = 0; r < kRows; ++r) sums[r] = four;
    } else if (step.added >= 0) {
      const Operand rows = tile.operand(tile.call.code.operands[step.added]);
#pragma unroll
      for (int r = 0; r < kRows; ++r) {
        const int at = row + kApart * r;
        const auto added = [&](int i) {
          return at < samples && first + i < step.width ? rows.at(at, first + i) : 0.0f;
        };
        sums[r] = make_float4(added(0), added(1), added(2), added(3));
      }
    }
    const float* w = tile.packed(step.weights) + first;
    int k = 0;
    if ((step.x.start | step.x.stride) % 4 == 0) {
#pragma unroll 2
      for (; k + 4 <= depth; k += 4, w += 4 * stride) {
        float4 y[4];
#pragma unroll
        for (int i = 0; i < 4; ++i) y[i] = load_constant(reinterpret_cast<const float4*>(w + i * stride));
#pragma unroll
        for (int r = 0; r < kRows; ++r) {
          const float4 four = *reinterpret_cast<const float4*>(x + r * down + k);
          accumulate(sums[r], four.x, y[0]);
          accumulate(sums[r], four.y, y[1]);
          accumulate(sums[r], four.z, y[2]);
          accumulate(sums[r], four.w, y[3]);
        }
      }
    }
#pragma unroll 1
    for (; k < depth; ++k, w += stride) {
      const float4 y = load_constant(reinterpret_cast<const float4*>(w));
#pragma unroll
      for (int r = 0; r < kRows; ++r) accumulate(sums[r], x[r * down + k], y);
    }
    const ProductValue slope = product_value<false>(tile, step.y, false);
    float* const to = tile.slot(step.slot) + first;
#pragma unroll
    for (int r = 0; r < kRows; ++r) {
      const int at = row + kApart * r;
      if (at >= samples) continue;
      float four[4] = {sums[r].x, sums[r].y, sums[r].z, sums[r].w};
#pragma unroll
      for (int i = 0; i < 4; ++i) {  // comparisons keep NaN
        if (step.is(kRelu)) four[i] = four[i] < 0.0f ? 0.0f : four[i];
        if (step.is(kSloped)) four[i] = slope.at(at, first + i) <= 0.0f ? 0.0f : four[i];
      }
      if (first + 4 <= step.width) {
        *reinterpret_cast<float4*>(to + at * step.stride) = make_float4(four[0], four[1], four[2], four[3]);
        continue;
      }
#pragma unroll
      for (int i = 0; i < 3; ++i) {
        if (first + i < step.width) to[at * step.stride + i] = four[i];
      }
    }
  }
  static __device__ __forceinline__ void accumulate(float4& sums, float x, const float4& y) {
    sums.x = fmaf(x, y.x, sums.x);
    sums.y = fmaf(x, y.y, sums.y);
    sums.z = fmaf(x, y.z, sums.z);
    sums.w = fmaf(x, y.w, sums.w);
  }
};

}  // namespace voronerf
