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

// addresses: sigma, rgb, depths, deltas, offsets, background; colour, opacity, depth, weights; then for the backward
// pass the gradients of colour, opacity, depth and weights, and where those of sigma, rgb, depths, deltas and
// background go. sizes: r, s, m, c, whether the background is per ray.
void composite(const std::vector<Address>& addresses, const std::vector<int64_t>& sizes, int isa, int threads) {
  VN_CHECK((addresses.size() == 10 || addresses.size() == 19) && sizes.size() == 5, "composite: arguments missing");
  const auto read = [&](size_t i) { return reinterpret_cast<const float*>(addresses[i]); };
  const auto write = [&](size_t i) { return reinterpret_cast<float*>(addresses[i]); };
  const voronerf::CompositeInputs in{
      read(0),  read(1),  read(2),  read(3), reinterpret_cast<const int32_t*>(addresses[4]), read(5), sizes[4] != 0,
      sizes[0], sizes[1], sizes[2], sizes[3]};
  const voronerf::CompositeOutputs out{write(6), write(7), write(8), write(9)};
  if (addresses.size() == 10) return voronerf::composite_cpu(in, out, static_cast<voronerf::Isa>(isa), threads);
  const voronerf::CompositeGradients gradients{read(10),  read(11),  read(12),  read(13), write(14),
                                               write(15), write(16), write(17), write(18)};
  voronerf::composite_backward_cpu(in, out, gradients, static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_composite(py::module_& module) {
  module.def("composite", &composite, py::call_guard<py::gil_scoped_release>());
}
