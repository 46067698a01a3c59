// Encodings of rows, as operands, and the gradients of what was encoded.
#pragma once

#include "encoding/encode_math.h"
#include "encoding/spherical_harmonics_math.h"
#include "network/cuda/grouped_mlp_cuda.h"
#include "network/cuda/grouped_mlp_cuda_operands.h"

namespace voronerf {

static_assert(kMostHarmonics == kMlpDepth, "a row of harmonics is one that is padded");

// All harmonics of a direction, those beyond its degree 0.
__device__ inline void mlp_harmonics(int degree, const float* raw, float (&values)[kMostHarmonics]) {
#pragma unroll
  for (int c = 0; c < kMostHarmonics; ++c) values[c] = 0.0f;
  spherical_harmonics_of(raw[0], raw[1], raw[2], degree, values);
}

// One column of an encoding.
__device__ inline float mlp_encoded(const MlpCudaInput& input, const float* raw, int column) {
  if (column >= input.width) return 0.0f;
  if (input.degree > 0) {
    float values[kMostHarmonics], found = 0.0f;
    mlp_harmonics(input.degree, raw, values);
#pragma unroll
    for (int c = 0; c < kMostHarmonics; ++c) found = c == column ? values[c] : found;
    return found;
  }
  if (input.octaves < 0) return raw[column];
  const int features = input.integrated ? input.raw / 2 : input.raw;
  if (!input.integrated) {
    if (column < features) return raw[column];
    column -= features;
  }
  const int part = column / features, feature = column - part * features;
  const float scale = octave_scale(part / 2);
  const float value = sine_of_octave(raw[feature] * scale, part % 2 == 0 ? 0.0f : 0.5f);
  return input.integrated ? value * octave_blur(scale, raw[features + feature]) : value;
}

// x / 2 pi in two parts, exact to float32's square, so that a multiple of it by a power of 2 has a fraction.
struct MlpTurns {
  float high, low;
};
__device__ inline MlpTurns mlp_turns(float x) {
  constexpr float kHigh = 0.159154937f, kLow = 6.42063833e-9f;
  const float high = x * kHigh;
  return {high, fmaf(x, kLow, fmaf(x, kHigh, -high))};
}

// The encoding of three coordinates, a row a lane (with 16 rows, the octaves between two lanes), for rounded operands:
// an angle is reduced once for its sine and cosine, and neither is computed more exactly than is kept. By counting, a
// tenth of the instructions of going column by column, which were more than those of four layers of width 64.
template <typename Products>
__device__ void mlp_encode_three(const MlpCudaInput& input, typename Products::Element* to, const float* raw, int part,
                                 int parts) {
  const int before = input.integrated ? 0 : 3;
  MlpTurns turns[3];
#pragma unroll
  for (int feature = 0; feature < 3; ++feature) turns[feature] = mlp_turns(raw[feature]);
  for (int octave = part; octave < input.octaves; octave += parts) {
    const float scale = octave_scale(octave);
    float sines[3], cosines[3];
#pragma unroll
    for (int feature = 0; feature < 3; ++feature) {
      const float whole = turns[feature].high * scale;
      const float nearest = (whole + 12582912.0f) - 12582912.0f;
      const float angle = 6.28318531f * fmaf(turns[feature].low, scale, whole - nearest);
      const float blur = input.integrated ? octave_blur(scale, raw[3 + feature]) : 1.0f;
      sines[feature] = blur * fast_sine(angle);
      cosines[feature] = blur * fast_cosine(angle);
    }
    auto* columns = to + before + 6 * octave;
    if (input.integrated) {
      Products::store(columns, sines[0], sines[1]);
      Products::store(columns + 2, sines[2], cosines[0]);
      Products::store(columns + 4, cosines[1], cosines[2]);
    } else {
      // Pairs begin at even columns; the odd ends of an octave are stored alone.
      Products::store_one(columns, sines[0]);
      Products::store(columns + 1, sines[1], sines[2]);
      Products::store(columns + 3, cosines[0], cosines[1]);
      Products::store_one(columns + 5, cosines[2]);
    }
  }
  if (part > 0) return;
  if (!input.integrated) {
    Products::store(to, raw[0], raw[1]);
    Products::store_one(to + 2, raw[2]);
  }
  for (int column = input.width; column < input.padded; ++column) Products::store_one(to + column, 0.0f);
}

// Whether mlp_encode_three() holds for a row: angles whose turns a float32 counts.
__device__ inline bool mlp_are_near(const MlpCudaInput& input, const float* raw) {
  const float scale = octave_scale(input.octaves);
  return fabsf(raw[0]) * scale <= kLargestDeviceAngle && fabsf(raw[1]) * scale <= kLargestDeviceAngle &&
         fabsf(raw[2]) * scale <= kLargestDeviceAngle;
}

// Encodes a warp's rows into its region; rows past the end are zero.
template <typename Products, int kRows, typename Raw>
__device__ void mlp_encode(const MlpCudaInput& input, typename Products::Element* region, int64_t first, int64_t end,
                           const Raw& raw_of) {
  if (!input.used) return;
  const int lane = threadIdx.x % 32, pairs = input.padded / 2;
  if (input.degree > 0) {
    // A row a lane: the polynomials share their terms.
    if (lane >= kRows) return;
    float values[kMostHarmonics] = {};
    if (first + lane < end) mlp_harmonics(input.degree, raw_of(first + lane), values);
    auto* to = region + input.value + lane * input.stride;
#pragma unroll
    for (int c = 0; c < kMostHarmonics; c += 2) Products::store(to + c, values[c], values[c + 1]);
    return;
  }
  bool by_columns = true;
  if constexpr (Products::kRounded) {
    if (input.octaves > 0 && input.raw == (input.integrated ? 6 : 3)) {
      const int row = lane % kRows;
      const bool there = first + row < end;
      const float* raw = there ? raw_of(first + row) : nullptr;
      const bool near = !there || mlp_are_near(input, raw);
      by_columns = __ballot_sync(kAllLanes, near) != kAllLanes;
      auto* to = region + input.value + row * input.stride;
      if (there && near) mlp_encode_three<Products>(input, to, raw, lane / kRows, 32 / kRows);
      if (!there) {
        for (int column = 2 * (lane / kRows); column < input.padded; column += 64 / kRows) {
          Products::store(to + column, 0.0f, 0.0f);
        }
      }
      if (by_columns) __syncwarp();
    }
  }
  if (!by_columns) return;
  for (int i = lane; i < kRows * pairs; i += 32) {
    const int row = i / pairs, column = 2 * (i - row * pairs);
    float x = 0.0f, y = 0.0f;
    if (first + row < end) {
      const float* raw = raw_of(first + row);
      x = mlp_encoded(input, raw, column);
      y = mlp_encoded(input, raw, column + 1);
    }
    Products::store(region + input.value + row * input.stride + column, x, y);
  }
}

// Gradient of one raw feature of a row, and of its variance, from the row's encoding.
template <typename Products>
__device__ void mlp_encode_gradient(const MlpCudaInput& input, const typename Products::Element* gradient,
                                    const float* raw, int feature, float* result) {
  if (input.degree > 0) {
    float given[kMostHarmonics], found[3];
#pragma unroll
    for (int c = 0; c < kMostHarmonics; ++c) given[c] = c < input.width ? Products::load(gradient + c) : 0.0f;
    spherical_harmonics_gradient(raw[0], raw[1], raw[2], input.degree, given, found);
    result[feature] = feature == 0 ? found[0] : feature == 1 ? found[1] : found[2];
    return;
  }
  const int features = input.integrated ? input.raw / 2 : input.raw;
  gradient += feature;
  float sum = 0.0f, of_variance = 0.0f;
  if (!input.integrated) {
    sum = Products::load(gradient);
    gradient += features;
  }
  for (int octave = 0; octave < input.octaves; ++octave, gradient += 2 * features) {
    const float scale = octave_scale(octave), angle = raw[feature] * scale;
    const float sine = sine_of_octave(angle, 0.0f), cosine = sine_of_octave(angle, 0.5f);
    const float of_sine = Products::load(gradient), of_cosine = Products::load(gradient + features);
    const float blur = input.integrated ? octave_blur(scale, raw[features + feature]) : 1.0f;
    sum += scale * blur * (of_sine * cosine - of_cosine * sine);
    of_variance += -0.5f * scale * scale * blur * (of_sine * sine + of_cosine * cosine);
  }
  result[feature] = sum;
  if (input.integrated) result[features + feature] = of_variance;
}

}  // namespace voronerf
