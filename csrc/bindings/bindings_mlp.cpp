// grouped_mlp for Python: a layer table as a flat list of integers, addresses and sizes in, the GIL released while it
// runs.
#include "bindings/bindings_mlp.h"

#include <pybind11/stl.h>

#include <cstdint>
#include <vector>

#include "bindings/bindings_mlp_table.h"
#include "common/common.h"
#include "network/grouped_linear.h"
#include "network/grouped_mlp.h"

namespace py = pybind11;

namespace {

using mlp_arguments::Address;
using mlp_arguments::at;
using mlp_arguments::pointers;
using mlp_arguments::read_inputs;
using mlp_arguments::read_table;

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

voronerf::LinearInputs linear(Address x, Address offsets, Address weight, Address bias, int64_t n, int64_t k, int64_t i,
                              int64_t o, int activation, bool bfloat16) {
  return {at<const void>(x),
          at<const int32_t>(offsets),
          at<const void>(weight),
          at<const void>(bias),
          n,
          k,
          i,
          o,
          static_cast<voronerf::Activation>(activation),
          bfloat16};
}

void grouped_linear(Address x, Address offsets, Address weight, Address bias, int64_t n, int64_t k, int64_t i,
                    int64_t o, int activation, bool bfloat16, Address out, int isa, int threads) {
  voronerf::grouped_linear_cpu(linear(x, offsets, weight, bias, n, k, i, o, activation, bfloat16), at<void>(out),
                               static_cast<voronerf::Isa>(isa), threads);
}

// Gradients: 0 where not wanted.
void grouped_linear_backward(Address x, Address offsets, Address weight, Address bias, int64_t n, int64_t k, int64_t i,
                             int64_t o, int activation, bool bfloat16, Address grad_out, Address grad_x,
                             Address grad_weight, Address grad_bias, int isa, int threads) {
  voronerf::grouped_linear_backward_cpu(
      linear(x, offsets, weight, bias, n, k, i, o, activation, bfloat16),
      {at<const void>(grad_out), at<void>(grad_x), at<void>(grad_weight), at<void>(grad_bias)},
      static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_mlp(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("grouped_mlp", &grouped_mlp, no_gil);
  module.def("grouped_mlp_backward", &grouped_mlp_backward, no_gil);
  module.def("grouped_linear", &grouped_linear, no_gil);
  module.def("grouped_linear_backward", &grouped_linear_backward, no_gil);
}
