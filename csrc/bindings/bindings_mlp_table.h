// How voronerf/native/grouped_mlp.py passes a layer table and the arguments of grouped_mlp, on the CPU and on CUDA.
#pragma once

#include <cstdint>
#include <vector>

#include "common/common.h"
#include "network/grouped_mlp.h"

namespace mlp_arguments {

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

template <typename T>
std::vector<T*> pointers(const std::vector<Address>& addresses) {
  std::vector<T*> result;
  for (const Address address : addresses) result.push_back(at<T>(address));
  return result;
}

// [p, q, position octaves, direction octaves, half, caller, integrated, layers, outputs, then for each layer: width,
// activation, sources, the sources; then the outputs], as voronerf/native/grouped_mlp.py writes it.
inline voronerf::MlpTable read_table(const std::vector<int64_t>& flat) {
  size_t next = 0;
  const auto take = [&] {
    VN_CHECK(next < flat.size(), "grouped_mlp: the layer table is too short");
    return flat[next++];
  };
  voronerf::MlpTable table;
  table.positions = take();
  table.directions = take();
  table.position_octaves = static_cast<int>(take());
  table.direction_octaves = static_cast<int>(take());
  table.half = take() != 0;
  table.caller = static_cast<voronerf::MlpCaller>(take());
  table.integrated = take() != 0;
  const int64_t layers = take(), outputs = take();
  for (int64_t l = 0; l < layers; ++l) {
    voronerf::MlpTable::Layer layer;
    layer.width = take();
    layer.activation = static_cast<voronerf::Activation>(take());
    const int64_t sources = take();
    for (int64_t s = 0; s < sources; ++s) layer.inputs.push_back(static_cast<int>(take()));
    for (const int from : layer.inputs)
      VN_CHECK(from >= -2 && from < l, "grouped_mlp: the layer table is out of order");
    table.layers.push_back(layer);
  }
  for (int64_t o = 0; o < outputs; ++o) {
    table.outputs.push_back(static_cast<int>(take()));
    VN_CHECK(table.outputs.back() >= 0 && table.outputs.back() < layers, "grouped_mlp: an output names no layer");
  }
  return table;
}

// Inputs of a call, in the order of `arguments`: positions, directions, direction_index, offsets, order, then n, r, k.
inline voronerf::MlpInputs read_inputs(const std::vector<Address>& arguments, const std::vector<const float*>& weights,
                                       const std::vector<const float*>& biases) {
  VN_CHECK(arguments.size() == 8, "grouped_mlp: eight arguments expected");
  voronerf::MlpInputs in{};
  in.positions = at<const float>(arguments[0]);
  in.directions = at<const float>(arguments[1]);
  in.direction_index = at<const int32_t>(arguments[2]);
  in.offsets = at<const int32_t>(arguments[3]);
  in.order = at<const int32_t>(arguments[4]);
  in.n = static_cast<int64_t>(arguments[5]);
  in.r = static_cast<int64_t>(arguments[6]);
  in.k = static_cast<int64_t>(arguments[7]);
  in.weights = weights.data();
  in.biases = biases.data();
  return in;
}

}  // namespace mlp_arguments
