// grouped_mlp for Python: a layer table as a flat list of integers, addresses and sizes in, the GIL released while it
// runs.
#include "bindings_mlp.h"

#include <pybind11/stl.h>

#include <cstdint>
#include <vector>

#include "common.h"
#include "grouped_mlp.h"

namespace py = pybind11;

namespace {

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
// activation, sources, the sources; then the outputs], as voronerf/_native_mlp.py writes it.
voronerf::MlpTable read_table(const std::vector<int64_t>& flat) {
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
voronerf::MlpInputs read_inputs(const std::vector<Address>& arguments, const std::vector<const float*>& weights,
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

void grouped_mlp(const std::vector<int64_t>& flat, const std::vector<Address>& arguments,
                 const std::vector<Address>& weights, const std::vector<Address>& biases, Address out, int isa,
                 int threads) {
  const auto w = pointers<const float>(weights), b = pointers<const float>(biases);
  voronerf::grouped_mlp_cpu(read_table(flat), read_inputs(arguments, w, b), at<float>(out),
                            static_cast<voronerf::Isa>(isa), threads);
}

// Gradients: those of the weights and of the biases (both lists empty: not wanted), of positions and directions (0: not
// wanted).
void grouped_mlp_backward(const std::vector<int64_t>& flat, const std::vector<Address>& arguments,
                          const std::vector<Address>& weights, const std::vector<Address>& biases, Address grad_out,
                          const std::vector<Address>& grad_weights, const std::vector<Address>& grad_biases,
                          Address grad_positions, Address grad_directions, int isa, int threads) {
  const auto w = pointers<const float>(weights), b = pointers<const float>(biases);
  const auto gw = pointers<float>(grad_weights), gb = pointers<float>(grad_biases);
  voronerf::MlpGradients gradients{};
  gradients.output = at<const float>(grad_out);
  gradients.weights = gw.empty() ? nullptr : gw.data();
  gradients.biases = gb.data();
  gradients.positions = at<float>(grad_positions);
  gradients.directions = at<float>(grad_directions);
  voronerf::grouped_mlp_backward_cpu(read_table(flat), read_inputs(arguments, w, b), gradients,
                                     static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_mlp(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("grouped_mlp", &grouped_mlp, no_gil);
  module.def("grouped_mlp_backward", &grouped_mlp_backward, no_gil);
}
