// composite for Python: addresses and sizes in, the GIL released while it runs.
#include "bindings/bindings_composite.h"

#include <pybind11/stl.h>

#include <cstdint>
#include <vector>

#include "bindings/bindings_mlp.h"
#include "rays/composite.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

void composite(const std::vector<Address>& inputs, const std::vector<int64_t>& sizes,
               const std::vector<Address>& results, int isa, int threads) {
  voronerf::composite_cpu(composite_inputs(inputs, sizes), composite_outputs(results), static_cast<voronerf::Isa>(isa),
                          threads);
}

void composite_backward(const std::vector<Address>& inputs, const std::vector<int64_t>& sizes,
                        const std::vector<Address>& incoming, const std::vector<Address>& outgoing, int isa,
                        int threads) {
  voronerf::composite_backward_cpu(composite_inputs(inputs, sizes), composite_gradients(incoming, outgoing),
                                   static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_composite(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("composite", &composite, no_gil);
  module.def("composite_backward", &composite_backward, no_gil);
}
