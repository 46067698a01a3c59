// composite for Python: addresses and sizes in, the GIL released while it runs.
#include <pybind11/stl.h>

#include <cstdint>
#include <vector>

#include "bindings_mlp.h"
#include "common.h"
#include "composite.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

voronerf::CompositeInputs read_inputs(const std::vector<Address>& addresses, const std::vector<int64_t>& sizes) {
  VN_CHECK(addresses.size() == 6 && sizes.size() == 5, "composite: arguments missing");
  const auto read = [&](size_t i) { return reinterpret_cast<const float*>(addresses[i]); };
  return {read(0),  read(1),  read(2),  read(3), reinterpret_cast<const int32_t*>(addresses[4]), read(5), sizes[4] != 0,
          sizes[0], sizes[1], sizes[2], sizes[3]};
}

// inputs: sigma, rgb, depths, deltas, offsets, background. sizes: r, s, m, c, whether the background is per ray.
// results: colour, opacity, depth, weights.
void composite(const std::vector<Address>& inputs, const std::vector<int64_t>& sizes,
               const std::vector<Address>& results, int isa, int threads) {
  VN_CHECK(results.size() == 4, "composite: results missing");
  const auto write = [&](size_t i) { return reinterpret_cast<float*>(results[i]); };
  const voronerf::CompositeOutputs out{write(0), write(1), write(2), write(3)};
  voronerf::composite_cpu(read_inputs(inputs, sizes), out, static_cast<voronerf::Isa>(isa), threads);
}

// incoming: gradients of colour, opacity, depth and weights, 0 for zero. outgoing: where those of sigma, rgb, depths,
// deltas and background go, 0 where not wanted, and the workspace.
void composite_backward(const std::vector<Address>& inputs, const std::vector<int64_t>& sizes,
                        const std::vector<Address>& incoming, const std::vector<Address>& outgoing, int isa,
                        int threads) {
  VN_CHECK(incoming.size() == 4 && outgoing.size() == 6, "composite: gradients missing");
  const auto read = [&](size_t i) { return reinterpret_cast<const float*>(incoming[i]); };
  const auto write = [&](size_t i) { return reinterpret_cast<float*>(outgoing[i]); };
  const voronerf::CompositeGradients gradients{read(0),  read(1),  read(2),  read(3),  write(0),
                                               write(1), write(2), write(3), write(4), write(5)};
  voronerf::composite_backward_cpu(read_inputs(inputs, sizes), gradients, static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_composite(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("composite", &composite, no_gil);
  module.def("composite_backward", &composite_backward, no_gil);
}
