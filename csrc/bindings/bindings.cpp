// The Python module voronerf._C: addresses and sizes in, nothing owned, the GIL released. voronerf/native/__init__.py
// is its only importer; it has validated shapes, dtypes and devices, made tensors contiguous and allocated outputs and
// workspaces.
#include <pybind11/pybind11.h>

#include <cstdint>

#include "bindings/bindings_balance.h"
#include "bindings/bindings_cuda.h"
#include "bindings/bindings_grid.h"
#include "bindings/bindings_march.h"
#include "bindings/bindings_mlp.h"
#include "bindings/bindings_sampling.h"
#include "build_info.h"
#include "common/common.h"
#include "common/huge_pages.h"
#include "common/isa.h"
#include "common/measure_peak.h"
#include "geometry/cell_sort.h"
#include "geometry/locate_cell.h"
#include "geometry/nearest_centre.h"

namespace py = pybind11;

namespace {

// Number of the interface between this module and voronerf/native/, which refuses a module of another number. It
// goes up with every change to the names, arguments or meaning of what is bound, in any bindings_*.cpp.
constexpr int INTERFACE = 13;

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

template <typename T>
void nearest_centre(Address points, Address centres, Address weights, Address cells, int64_t n, int64_t k, int isa,
                    int threads) {
  voronerf::nearest_centre_cpu(at<const T>(points), at<const T>(centres), at<const T>(weights), at<int32_t>(cells), n,
                               k, static_cast<voronerf::Isa>(isa), threads);
}

template <typename T>
bool locate_cell(Address points, Address centres, Address weights, Address child_offsets, Address child, Address leaves,
                 Address workspace, int64_t n, int64_t m, int depth, int isa, int threads) {
  return voronerf::locate_cell_cpu(at<const T>(points), at<const T>(centres), at<const T>(weights),
                                   at<const int32_t>(child_offsets), at<const int32_t>(child), at<int32_t>(leaves),
                                   at<int32_t>(workspace), n, m, depth, static_cast<voronerf::Isa>(isa), threads);
}

bool cell_sort(Address cells, Address order, Address offsets, Address workspace, int64_t n, int64_t k, int threads) {
  return voronerf::cell_sort_cpu(at<const int32_t>(cells), at<int32_t>(order), at<int32_t>(offsets),
                                 at<int32_t>(workspace), n, k, threads);
}

double measure_peak(int kind, int isa, int threads) {
  return voronerf::measure_peak(static_cast<voronerf::Peak>(kind), static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

PYBIND11_MODULE(_C, module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();

  module.attr("interface") = INTERFACE;
  module.attr("compiler") = VN_COMPILER;
  module.attr("openmp") = static_cast<bool>(VN_OPENMP);
  module.attr("cuda") = static_cast<bool>(VN_CUDA);
  module.attr("cuda_outcome") = VN_CUDA_OUTCOME;
  module.attr("cuda_architectures") = VN_CUDA_ARCHITECTURES;
  module.def("isa_supported", [](int isa) { return voronerf::isa_supported(static_cast<voronerf::Isa>(isa)); });
  module.def("measure_peak", &measure_peak, no_gil);
  module.def("advise_huge_pages",
             [](Address memory, int64_t bytes) { voronerf::advise_huge_pages(at<void>(memory), bytes); });

  module.def("nearest_centre_float32", &nearest_centre<float>, no_gil);
  module.def("nearest_centre_float64", &nearest_centre<double>, no_gil);

  module.def("locate_cell_float32", &locate_cell<float>, no_gil);
  module.def("locate_cell_float64", &locate_cell<double>, no_gil);
  module.def("locate_cell_workspace", &voronerf::locate_cell_workspace);
  module.def("locate_cell_fault", [](Address child_offsets, Address child, int64_t g, int64_t m) {
    return voronerf::locate_cell_fault(at<const int32_t>(child_offsets), at<const int32_t>(child), g, m);
  });

  module.def("cell_sort", &cell_sort, no_gil);
  module.def("cell_sort_workspace", &voronerf::cell_sort_workspace);

  bind_mlp(module);
  bind_composite(module);
  bind_sampling(module);
  bind_march(module);
  bind_grid(module);
  bind_balance(module);

#ifdef VN_WITH_CUDA
  bind_cuda(module);
#endif
}
