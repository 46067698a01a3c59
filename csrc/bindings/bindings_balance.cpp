// balance_centres for Python: addresses and sizes in, the GIL released while it runs.
#include "bindings/bindings_balance.h"

#include <cstdint>

#include "geometry/balance_centres.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

void balance_centres(Address samples, Address masses, Address centres, Address weights, Address cells,
                     Address workspace, int64_t m, int64_t k, int64_t steps, double alpha, int64_t neighbours,
                     bool global, int isa, int threads) {
  const voronerf::BalanceInputs in{
      at<const float>(samples), at<const double>(masses), m, k, steps, alpha, neighbours, global};
  voronerf::balance_centres_cpu(in, at<float>(centres), at<double>(weights), at<int32_t>(cells), at<double>(workspace),
                                static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_balance(py::module_& module) {
  module.def("balance_centres_workspace", &voronerf::balance_centres_workspace);
  module.def("balance_centres", &balance_centres, py::call_guard<py::gil_scoped_release>());
}
