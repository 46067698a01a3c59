// The CUDA launchers for Python: addresses of device memory, sizes, a device and its stream in; nothing owned, the GIL
// released. Empty in a build without CUDA.
#include "bindings/bindings_cuda.h"

#ifdef VN_WITH_CUDA

#include <pybind11/stl.h>

#include <cstdint>
#include <vector>

#include "bindings/bindings_composite.h"
#include "bindings/bindings_mlp_table.h"
#include "bindings/launchers.h"
#include "network/cuda/grouped_mlp_cuda_layers.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

template <typename T>
void nearest_centre_cuda(Address points, Address centres, Address weights, Address cells, int64_t n, int64_t k,
                         int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::nearest_centre_cuda(at<const T>(points), at<const T>(centres), at<const T>(weights), at<int32_t>(cells), n,
                                k, at<void>(stream));
}

template <typename T>
void locate_cell_cuda(Address points, Address centres, Address weights, Address child_offsets, Address child,
                      Address leaves, int64_t n, int64_t m, int64_t g, int depth, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::locate_cell_cuda(at<const T>(points), at<const T>(centres), at<const T>(weights),
                             at<const int32_t>(child_offsets), at<const int32_t>(child), at<int32_t>(leaves), n, m, g,
                             depth, at<void>(stream));
}

void draw_cell_cuda(Address points, Address centres, Address weights, Address child_offsets, Address child,
                    Address uniforms, Address leaves, int64_t n, int64_t m, int64_t g, int depth, double temperature,
                    int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::draw_cell_cuda(at<const float>(points), at<const float>(centres), at<const float>(weights),
                           at<const int32_t>(child_offsets), at<const int32_t>(child), at<const float>(uniforms),
                           at<int32_t>(leaves), n, m, g, depth, temperature, at<void>(stream));
}

// way: a number of CellSortWay.
int64_t cell_sort_workspace_cuda(int64_t n, int64_t k, int way, int device) {
  const voronerf::CudaDevice current(device);
  return voronerf::cell_sort_workspace_cuda(n, k, static_cast<voronerf::CellSortWay>(way));
}

void cell_sort_cuda(Address cells, Address order, Address offsets, Address workspace, int64_t n, int64_t k, int way,
                    int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::cell_sort_cuda(at<const int32_t>(cells), at<int32_t>(order), at<int32_t>(offsets),
                           at<unsigned char>(workspace), n, k, static_cast<voronerf::CellSortWay>(way),
                           at<void>(stream));
}

using Addresses = std::vector<Address>;

void composite_cuda(const Addresses& inputs, const std::vector<int64_t>& sizes, const Addresses& results, int device,
                    Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::composite_cuda(composite_inputs(inputs, sizes), composite_outputs(results), at<void>(stream));
}

void composite_backward_cuda(const Addresses& inputs, const std::vector<int64_t>& sizes, const Addresses& incoming,
                             const Addresses& outgoing, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::composite_backward_cuda(composite_inputs(inputs, sizes), composite_gradients(incoming, outgoing),
                                    at<void>(stream));
}

void encode_cuda(Address x, Address variances, Address out, int64_t n, int64_t d, int64_t octaves, bool include_input,
                 int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::encode_cuda(at<const float>(x), at<const float>(variances), at<float>(out), n, d, octaves, include_input,
                        at<void>(stream));
}

void encode_backward_cuda(Address gradient, Address x, Address variances, Address grad_x, Address grad_variances,
                          int64_t n, int64_t d, int64_t octaves, bool include_input, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::encode_backward_cuda(at<const float>(gradient), at<const float>(x), at<const float>(variances),
                                 at<float>(grad_x), at<float>(grad_variances), n, d, octaves, include_input,
                                 at<void>(stream));
}

void resample_cuda(Address weights, Address edges, Address uniforms, Address depths, Address workspace, int64_t r,
                   int64_t s, int64_t count, int device, Address stream) {
  const voronerf::CudaDevice current(device);
  voronerf::resample_cuda(at<const float>(weights), at<const float>(edges), at<const float>(uniforms),
                          at<float>(depths), at<double>(workspace), r, s, count, at<void>(stream));
}

// precision, way: numbers of MlpPrecision and MlpCudaWay; the plan is made for the device that is current.
const char* plan_of(const std::vector<int64_t>& flat, int precision, int64_t n, int64_t k, bool backward, int way,
                    voronerf::MlpCudaChoice& choice) {
  const auto wanted = static_cast<voronerf::MlpCudaWay>(way);
  voronerf::MlpCudaDevice known = voronerf::mlp_cuda_device();
  known.groups = wanted == voronerf::MlpCudaWay::groups && voronerf::mlp_chain_groups_compiled();
  return voronerf::mlp_cuda_choose(mlp_arguments::read_table(flat), static_cast<voronerf::MlpPrecision>(precision), n,
                                   k, backward, wanted, known, choice);
}

// Bytes of workspace, or the rule that a table breaks for which there is no plan.
py::object grouped_mlp_workspace_cuda(const std::vector<int64_t>& flat, int precision, int64_t n, int64_t k,
                                      bool backward, bool parameters, int device, int way) {
  const voronerf::CudaDevice current(device);
  voronerf::MlpCudaChoice choice;
  if (const char* fault = plan_of(flat, precision, n, k, backward, way, choice)) return py::str(fault);
  switch (choice.way) {
    case voronerf::MlpCudaWay::chain:
      return py::int_(voronerf::mlp_chain_workspace(choice.chain, k).bytes);
    case voronerf::MlpCudaWay::tiles:
      return py::int_(voronerf::mlp_cuda_workspace(choice.fused, k, parameters).bytes);
    default:
      return py::int_(voronerf::mlp_layers_workspace(choice.layers, k, parameters).bytes);
  }
}

voronerf::MlpCudaData data_of(const voronerf::MlpInputs& in) {
  voronerf::MlpCudaData data{};
  data.positions = in.positions;
  data.directions = in.directions;
  data.direction_index = in.direction_index;
  data.order = in.order;
  data.offsets = in.offsets;
  data.n = in.n;
  data.k = in.k;
  return data;
}

// Of any number of layers.
voronerf::MlpLayersParameters layers_of(const Addresses& weights, const Addresses& biases) {
  return {mlp_arguments::pointers<const float>(weights), mlp_arguments::pointers<const float>(biases)};
}

voronerf::MlpCudaParameters parameters_of(const Addresses& weights, const Addresses& biases) {
  voronerf::MlpCudaParameters parameters{};
  for (size_t l = 0; l < weights.size() && l < voronerf::kMlpCudaLayers; ++l) {
    parameters.weights[l] = at<const float>(weights[l]);
    parameters.biases[l] = at<const float>(biases[l]);
  }
  return parameters;
}

void grouped_mlp_cuda(const std::vector<int64_t>& flat, const Addresses& arguments, const Addresses& weights,
                      const Addresses& biases, Address out, int precision, Address workspace, int device,
                      Address stream, int way) {
  const voronerf::CudaDevice current(device);
  voronerf::MlpCudaData data = data_of(mlp_arguments::read_inputs(arguments, {}, {}));
  data.out = at<float>(out);
  voronerf::MlpCudaChoice choice;
  const char* fault = plan_of(flat, precision, data.n, data.k, false, way, choice);
  VN_CHECK(fault == nullptr, fault);
  auto* memory = at<unsigned char>(workspace);
  switch (choice.way) {
    case voronerf::MlpCudaWay::chain:
      return voronerf::mlp_chain_cuda(choice.chain, data, parameters_of(weights, biases), memory, at<void>(stream));
    case voronerf::MlpCudaWay::tiles:
      return voronerf::grouped_mlp_cuda(choice.fused, data, parameters_of(weights, biases), memory, at<void>(stream));
    default:
      return voronerf::mlp_layers_cuda(choice.layers, data, layers_of(weights, biases), memory, at<void>(stream));
  }
}

// As on the CPU, except that gradients of directions are one row a sample.
void grouped_mlp_backward_cuda(const std::vector<int64_t>& flat, const Addresses& arguments, const Addresses& weights,
                               const Addresses& biases, Address grad_out, const Addresses& grad_weights,
                               const Addresses& grad_biases, Address grad_positions, Address grad_directions,
                               int precision, Address workspace, int device, Address stream, int way) {
  const voronerf::CudaDevice current(device);
  voronerf::MlpCudaData data = data_of(mlp_arguments::read_inputs(arguments, {}, {}));
  data.grad_out = at<const float>(grad_out);
  data.grad_positions = at<float>(grad_positions);
  data.grad_directions = at<float>(grad_directions);
  voronerf::MlpCudaChoice choice;
  const char* fault = plan_of(flat, precision, data.n, data.k, true, way, choice);
  VN_CHECK(fault == nullptr, fault);
  auto* memory = at<unsigned char>(workspace);
  if (choice.way == voronerf::MlpCudaWay::layers) {
    const voronerf::MlpLayersGradients results = {mlp_arguments::pointers<float>(grad_weights),
                                                  mlp_arguments::pointers<float>(grad_biases)};
    return voronerf::mlp_layers_backward_cuda(choice.layers, data, layers_of(weights, biases),
                                              grad_weights.empty() ? nullptr : &results, memory, at<void>(stream));
  }
  voronerf::MlpCudaParameterGradients gradients{};
  for (size_t l = 0; l < grad_weights.size() && l < voronerf::kMlpCudaLayers; ++l) {
    gradients.weights[l] = at<float>(grad_weights[l]);
    gradients.biases[l] = at<float>(grad_biases[l]);
  }
  voronerf::grouped_mlp_backward_cuda(choice.fused, data, parameters_of(weights, biases),
                                      grad_weights.empty() ? nullptr : &gradients, memory, at<void>(stream));
}

}  // namespace

void bind_cuda(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("nearest_centre_cuda_float32", &nearest_centre_cuda<float>, no_gil);
  module.def("nearest_centre_cuda_float64", &nearest_centre_cuda<double>, no_gil);
  module.def("locate_cell_cuda_float32", &locate_cell_cuda<float>, no_gil);
  module.def("locate_cell_cuda_float64", &locate_cell_cuda<double>, no_gil);
  module.def("draw_cell_cuda", &draw_cell_cuda, no_gil);
  module.def("cell_sort_workspace_cuda", &cell_sort_workspace_cuda);
  module.def("cell_sort_cuda", &cell_sort_cuda, no_gil);
  module.def("composite_cuda", &composite_cuda, no_gil);
  module.def("composite_backward_cuda", &composite_backward_cuda, no_gil);
  module.def("encode_cuda", &encode_cuda, no_gil);
  module.def("encode_backward_cuda", &encode_backward_cuda, no_gil);
  module.def("grouped_mlp_workspace_cuda", &grouped_mlp_workspace_cuda);
  module.def("grouped_mlp_cuda", &grouped_mlp_cuda, no_gil);
  module.def("grouped_mlp_backward_cuda", &grouped_mlp_backward_cuda, no_gil);
  module.def("resample_cuda", &resample_cuda, no_gil);
}

#endif
