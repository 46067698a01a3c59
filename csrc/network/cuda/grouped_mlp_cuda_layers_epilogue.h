// What the products of grouped_mlp_cuda_layers.cu do with their sums, for two columns of a row at a time.
#pragma once

#include "network/cuda/grouped_mlp_cuda_layers.h"
#include "network/cuda/grouped_mlp_cuda_tile.h"

namespace voronerf {

// What a layer does with its sums.
template <typename Products>
struct LayersForward {
  using Element = typename Products::Element;
  const float* bias;       // [k][width] or null
  Element *value, *slope;  // [rows][padded]; slope null unless kept
  float* out;              // null: no output
  const int32_t* order;
  int64_t first, out_features, width, padded;
  int64_t columns[kLayersOutputs];
  int outputs, activation;

  __device__ void operator()(int64_t cell, int64_t row, int64_t column, float x, float y) const {
    float pair[2] = {x, y};
    for (int part = 0; part < 2; ++part) {
      if (bias != nullptr && column + part < width) pair[part] += bias[cell * width + column + part];
    }
    if (slope != nullptr) Products::store(slope + row * padded + column, cosf(pair[0]), cosf(pair[1]));
    pair[0] = mlp_activate(activation, pair[0]);
    pair[1] = mlp_activate(activation, pair[1]);
    Products::store(value + row * padded + column, pair[0], pair[1]);
    if (out == nullptr) return;
    float* to = out + (order == nullptr ? first + row : order[first + row]) * out_features;
    for (int o = 0; o < outputs; ++o) {
      for (int part = 0; part < 2; ++part) {
        if (column + part < width) to[columns[o] + column + part] = pair[part];
      }
    }
  }
};

// What a value does with the sums of what comes back from its readers: adds what comes from outside, and puts the
// gradient of the layer's sums where the value was.
template <typename Products>
struct LayersBackward {
  using Element = typename Products::Element;
  Element* value;
  const Element* slope;  // the value, or a sine's derivative
  const float* grad_out;
  const int32_t* order;
  int64_t first, out_features, width, padded;
  int64_t columns[kLayersOutputs];
  int outputs, activation;

  __device__ void operator()(int64_t, int64_t row, int64_t column, float x, float y) const {
    float pair[2] = {x, y};
    if (outputs > 0) {
      const float* from = grad_out + (order == nullptr ? first + row : order[first + row]) * out_features;
      for (int o = 0; o < outputs; ++o) {
        for (int part = 0; part < 2; ++part) {
          if (column + part < width) pair[part] += from[columns[o] + column + part];
        }
      }
    }
    const int64_t at = row * padded + column;
    const float low = Products::load(slope + at), high = Products::load(slope + at + 1);
    Products::store_gradient(value + at, mlp_times_slope(activation, pair[0], low),
                             mlp_times_slope(activation, pair[1], high));
  }
};

}  // namespace voronerf
