// What a warp of the chained network does with 32 rows: encodings into fragments, products of fragments with packed
// weights, sums into the fragments of the next layer (grouped_mlp_cuda_chain.h). Lane l has rows l / 4 + 8 i, i 0 to 3,
// and of every eight columns 2 (l % 4) and the next.
#pragma once

#include <type_traits>

#include "network/cuda/grouped_mlp_cuda_chain.h"
#include "network/cuda/grouped_mlp_cuda_tile.h"

namespace voronerf {

// Fragments of a step of 16 columns, for two row tiles: the left operand of a product.
using MlpFragment = uint32_t[2][4];

// run(number of 8-column tiles, as a constant). Registers cannot be indexed, so there is code for each number.
template <int kMost, typename Run>
__device__ __forceinline__ void chain_with_tiles(int tiles, const Run& run) {
  if (tiles == 1) {
    run(std::integral_constant<int, 1>());
  } else if (tiles == 2) {
    run(std::integral_constant<int, 2>());
  } else if (kMost == 4 || tiles == 4) {
    run(std::integral_constant<int, 4>());
  } else {
    run(std::integral_constant<int, kMost>());
  }
}

// sums += values weights^T for a step; `weights` points at this lane's row of the step's first core matrix.
template <bool kBfloat16, int kTiles>
__device__ __forceinline__ void chain_multiply(MlpSums<2, kTiles>& sums, const MlpFragment& values,
                                               const unsigned char* weights) {
#pragma unroll
  for (int pair = 0; pair < chain_pairs(kTiles); ++pair) {
    uint32_t quad[4];
    load_matrices<false>(quad, weights + pair * kChainQuad);
    const uint32_t first[2] = {quad[0], quad[1]}, second[2] = {quad[2], quad[3]};
#pragma unroll
    for (int r = 0; r < 2; ++r) multiply_halves<kBfloat16>(sums[r][2 * pair], values[r], first);
    if constexpr (kTiles > 1) {
#pragma unroll
      for (int r = 0; r < 2; ++r) multiply_halves<kBfloat16>(sums[r][2 * pair + 1], values[r], second);
    }
  }
}

// The same for the first `steps` steps, all where kAll says so.
template <bool kBfloat16, bool kAll, int kTiles, int kSteps>
__device__ __forceinline__ void chain_multiply_steps(MlpSums<2, kTiles>& sums, const MlpFragment (&held)[kSteps],
                                                     int steps, const unsigned char* weights) {
#pragma unroll
  for (int step = 0; step < kSteps; ++step) {
    if (kAll || step < steps) {
      chain_multiply<kBfloat16>(sums, held[step], weights + step * chain_pairs(kTiles) * kChainQuad);
    }
  }
}

// Sums begin with the biases of a piece.
template <int kTiles>
__device__ __forceinline__ void chain_begin(MlpSums<2, kTiles>& sums, const float* biases) {
  const int member = thread_again() % 4;
#pragma unroll
  for (int tile = 0; tile < kTiles; ++tile) {
    const float2 bias = *reinterpret_cast<const float2*>(biases + 8 * tile + 2 * member);
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      sums[r][tile][0] = sums[r][tile][2] = bias.x;
      sums[r][tile][1] = sums[r][tile][3] = bias.y;
    }
  }
}

// Fragments of the steps that the sums of a chunk are for the layers that read them, the first of `values`: of one row
// tile, and of both.
template <bool kBfloat16, bool kRelu, int kRow, int kTiles, int kSteps>
__device__ __forceinline__ void chain_round_row(const MlpSums<2, kTiles>& sums, MlpFragment (&values)[kSteps]) {
#pragma unroll
  for (int step = 0; step < chain_pairs(kTiles) && step < kSteps; ++step) {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const float* left = sums[kRow][2 * step] + 2 * half;
      values[step][kRow][half] = pack_halves<kBfloat16, true, kRelu>(left[0], left[1]);
      if constexpr (kTiles > 1) {
        const float* right = sums[kRow][2 * step + 1] + 2 * half;
        values[step][kRow][2 + half] = pack_halves<kBfloat16, true, kRelu>(right[0], right[1]);
      } else {
        values[step][kRow][2 + half] = 0;
      }
    }
  }
}
template <bool kBfloat16, int kTiles, int kSteps>
__device__ __forceinline__ void chain_round(const MlpSums<2, kTiles>& sums, bool relu, MlpFragment (&values)[kSteps]) {
  if (relu) {
    chain_round_row<kBfloat16, true, 0>(sums, values);
    chain_round_row<kBfloat16, true, 1>(sums, values);
  } else {
    chain_round_row<kBfloat16, false, 0>(sums, values);
    chain_round_row<kBfloat16, false, 1>(sums, values);
  }
}

template <int kTiles>
__device__ __forceinline__ void chain_relu(MlpSums<2, kTiles>& sums) {
#pragma unroll
  for (int i = 0; i < 8 * kTiles; ++i) {
    float& x = sums[i / (4 * kTiles)][i / 4 % kTiles][i % 4];
    x = x < 0.0f ? 0.0f : x;
  }
}

// Fragments of steps to others, from number kFirst on, as many as there are in both.
template <int kFirst, int kTo, int kFrom>
__device__ __forceinline__ void chain_copy(MlpFragment (&to)[kTo], const MlpFragment (&from)[kFrom]) {
#pragma unroll
  for (int step = 0; step < kFrom && kFirst + step < kTo; ++step) {
#pragma unroll
    for (int i = 0; i < 8; ++i) to[kFirst + step][i / 4][i % 4] = from[step][i / 4][i % 4];
  }
}

// visit(tile, its sums) by code that is there once, as in mlp_for_each_tile().
template <int kTiles, typename Visit>
__device__ __forceinline__ void chain_for_each_tile(MlpSums<2, kTiles>& sums, const Visit& visit) {
#pragma unroll 1
  for (int tile = 0; tile < kTiles; ++tile) {
    MlpSums<2, 1> each;
#pragma unroll
    for (int r = 0; r < 2; ++r) {
#pragma unroll
      for (int i = 0; i < 4; ++i) each[r][0][i] = sums[r][0][i];
    }
    visit(tile, each);
#pragma unroll
    for (int r = 0; r < 2; ++r) {
#pragma unroll
      for (int i = 0; i < 4; ++i) {
#pragma unroll
        for (int t = 0; t + 1 < kTiles; ++t) sums[r][t][i] = sums[r][t + 1][i];
        sums[r][kTiles - 1][i] = each[r][0][i];
      }
    }
  }
}

// Activations that are long, two values at a time.
template <int kTiles>
__device__ __forceinline__ void chain_activate(MlpSums<2, kTiles>& sums, int activation) {
  chain_for_each_tile(sums, [&](int, MlpSums<2, 1>& each) {
    float values[8];
#pragma unroll
    for (int i = 0; i < 8; ++i) values[i] = each[i / 4][0][i % 4];
#pragma unroll 1
    for (int i = 0; i < 4; ++i) {
      const float x = mlp_activate(activation, values[0]), y = mlp_activate(activation, values[1]);
#pragma unroll
      for (int j = 0; j < 6; ++j) values[j] = values[j + 2];
      values[6] = x;
      values[7] = y;
    }
#pragma unroll
    for (int i = 0; i < 8; ++i) each[i / 4][0][i % 4] = values[i];
  });
}

// A chunk's results to the rows and columns of the output that are theirs: `to` is column 0 of the chunk in row 0.
template <int kTiles>
__device__ __forceinline__ void chain_write(MlpSums<2, kTiles>& sums, float* to, int64_t stride, int width,
                                            const int (&rows)[4]) {
  const bool paired = stride % 2 == 0 && width % 2 == 0 && reinterpret_cast<uintptr_t>(to) % 8 == 0;
  chain_for_each_tile(sums, [&](int tile, const MlpSums<2, 1>& each) {
    const int column = 8 * tile + 2 * (thread_again() % 4);
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      float* pair = to + static_cast<uint64_t>(static_cast<unsigned>(rows[i])) * static_cast<unsigned>(stride) + column;
      const float x = each[i / 2][0][i % 2 * 2], y = each[i / 2][0][i % 2 * 2 + 1];
      const bool first = rows[i] >= 0 && column < width, second = rows[i] >= 0 && column + 1 < width;
      if (paired) {
        if (first) *reinterpret_cast<float2*>(pair) = make_float2(x, y);
      } else {
        if (first) pair[0] = x;
        if (second) pair[1] = y;
      }
    }
  });
}

// What a warp keeps in shared memory between layers, [step][row tile][lane]: a lane reads what it wrote.
__device__ __forceinline__ void chain_store(unsigned char* region, int step, const MlpFragment& values) {
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    *reinterpret_cast<uint4*>(region + (2 * step + r) * kChainQuad + threadIdx.x % 32 * 16) =
        make_uint4(values[r][0], values[r][1], values[r][2], values[r][3]);
  }
}
__device__ __forceinline__ void chain_load(const unsigned char* region, int step, MlpFragment& values) {
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    const uint4 four = *reinterpret_cast<const uint4*>(region + (2 * step + r) * kChainQuad + threadIdx.x % 32 * 16);
    values[r][0] = four.x, values[r][1] = four.y, values[r][2] = four.z, values[r][3] = four.w;
  }
}

// The first kCount of `values`, and back.
template <int kCount, int kSteps>
__device__ __forceinline__ void chain_store_steps(unsigned char* region, const MlpFragment (&values)[kSteps]) {
#pragma unroll
  for (int step = 0; step < kCount && step < kSteps; ++step) chain_store(region, step, values[step]);
}
template <int kCount, int kSteps>
__device__ __forceinline__ void chain_load_steps(const unsigned char* region, MlpFragment (&values)[kSteps]) {
#pragma unroll
  for (int step = 0; step < kCount && step < kSteps; ++step) chain_load(region, step, values[step]);
}

// Rows of a warp: from `first` on the first `count`, which may be less than 32 or none.
struct MlpChainRows {
  unsigned first;
  int count;
};

// A lane's rows in the caller's arrays, with an index those of its entries; -1: none of the warp's. Looked up where
// they are wanted, rather than kept in registers; numbers of rows are below 2^31.
__device__ __forceinline__ void chain_source_rows(const MlpCudaData& data, MlpChainRows rows, const int32_t* index,
                                                  int (&found)[4]) {
  const int lane = thread_again() % 32;
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const int row = lane / 4 + 8 * i;
    const bool there = row < rows.count;
    found[i] = -1;
    if (there) found[i] = static_cast<int>(mlp_source_row(data, rows.first + row));
    if (there && index != nullptr) found[i] = mlp_within(index[found[i]], data.r);
  }
}

// 1 / 2 pi in two parts.
constexpr float kTurnHigh = 0.159154937f, kTurnLow = 6.42063833e-9f;

// The unit of an encoded input that a lane has in a step, moved on from step to step.
struct MlpChainUnit {
  int unit, feature;
  float scale;  // of the octave of its first two columns
};
__device__ __forceinline__ void chain_wrap_unit(const MlpChainInput& input, MlpChainUnit& unit) {
  while (unit.feature >= input.features) {
    unit.feature -= input.features;
    unit.scale *= 4.0f;
  }
}
__device__ __forceinline__ MlpChainUnit chain_first_unit(const MlpChainInput& input) {
  MlpChainUnit first = {thread_again() % 4, thread_again() % 4, 1.0f};
  chain_wrap_unit(input, first);
  return first;
}
__device__ __forceinline__ void chain_next_unit(const MlpChainInput& input, MlpChainUnit& unit) {
  unit.unit += 4;
  unit.feature += 4;
  chain_wrap_unit(input, unit);
}

// Raw features of a row from a first one on; one multiplication, by what is known to have no sign.
__device__ __forceinline__ const float* chain_raw(const float* first, int row, int raw) {
  return first + static_cast<uint64_t>(static_cast<unsigned>(row)) * static_cast<unsigned>(raw);
}

// A lane's unit of an input in its four rows of that input; missing rows (-1) are 0.
//
// One reduction and one sine and cosine serve two octaves, the second by the double angle, whose error of about 2e-6
// is below what 16 bits keep; blurs likewise, by the fourth power.
template <bool kBfloat16>
__device__ __forceinline__ void chain_encode(const MlpChainInput& input, const float* from, const int (&rows)[4],
                                             const MlpChainUnit& unit, MlpFragment& values) {
  if (unit.unit < input.units) {
    const bool second = unit.scale < input.last;
    float angles[4], turns[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      angles[i] = (rows[i] < 0 ? 0.0f : *chain_raw(from + unit.feature, rows[i], input.raw)) * unit.scale;
    }
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      // To the nearest whole turn; a fused multiplication leaves what is left exact.
      const float nearest = fmaf(angles[i], kTurnHigh, 12582912.0f) - 12582912.0f;
      turns[i] = fmaf(angles[i], kTurnLow, fmaf(angles[i], kTurnHigh, -nearest));
    }
    // The largest of those that are numbers; the others have become none already.
    const float most = fmaxf(fmaxf(fabsf(angles[0]), fabsf(angles[1])), fmaxf(fabsf(angles[2]), fabsf(angles[3])));
    if (most > kLargestDeviceAngle) {
#pragma unroll 1
      for (int i = 0; i < 4; ++i) {
        const float angle = i == 0 ? angles[0] : i == 1 ? angles[1] : i == 2 ? angles[2] : angles[3];
        if (!(fabsf(angle) > kLargestDeviceAngle)) continue;
        const float exact = turns_of_large(angle);
#pragma unroll
        for (int j = 0; j < 4; ++j) turns[j] = i == j ? exact : turns[j];
      }
    }
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const float angle = 6.28318531f * turns[i];
      const float sine = fast_sine(angle), cosine = fast_cosine(angle), twice = sine + sine;
      float pairs[4] = {sine, cosine, twice * cosine, fmaf(-twice, sine, 1.0f)};
      if (input.integrated) {
        const float variance =
            rows[i] < 0 ? 0.0f : *chain_raw(from + unit.feature + input.features, rows[i], input.raw);
        const float blur = octave_blur(unit.scale, variance), square = blur * blur;
        pairs[0] *= blur, pairs[1] *= blur, pairs[2] *= square * square, pairs[3] *= square * square;
      }
      values[i / 2][i % 2] = pack_halves<kBfloat16>(pairs[0], pairs[1]);
      values[i / 2][2 + i % 2] = second ? pack_halves<kBfloat16>(pairs[2], pairs[3]) : 0;
    }
  } else {
    const int feature = 4 * (unit.unit - input.units), left = (input.integrated ? 0 : input.raw) - feature;
    const bool whole = input.raw % 4 == 0 && reinterpret_cast<uintptr_t>(from) % 16 == 0;
    float four[4][4];
    if (whole) {
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        float4 all = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (left > 0 && rows[i] >= 0)
          all = *reinterpret_cast<const float4*>(chain_raw(from + feature, rows[i], input.raw));
        four[i][0] = all.x, four[i][1] = all.y, four[i][2] = all.z, four[i][3] = all.w;
      }
    } else {
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        const float* raw = chain_raw(from + feature, rows[i], input.raw);
#pragma unroll
        for (int j = 0; j < 4; ++j) four[i][j] = rows[i] >= 0 && j < left ? raw[j] : 0.0f;
      }
    }
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      values[i / 2][i % 2] = pack_halves<kBfloat16>(four[i][0], four[i][1]);
      values[i / 2][2 + i % 2] = pack_halves<kBfloat16>(four[i][2], four[i][3]);
    }
  }
}

}  // namespace voronerf
