// The centre grid for Python.
#include "bindings/bindings_grid.h"

#include <algorithm>
#include <cstdint>
#include <utility>

#include "geometry/centre_grid.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

template <typename T>
void nearest_centre_grid(Address points, Address centres, Address weights, Address frame, Address entries,
                         Address lists, Address table, Address cells, int64_t n, int64_t k, int bits, int isa,
                         int threads) {
  const voronerf::CentreGrid grid{at<const float>(frame), at<const int32_t>(entries), at<const int32_t>(lists),
                                  at<const float>(table), bits};
  voronerf::nearest_centre_grid_cpu(at<const T>(points), at<const T>(centres), at<const T>(weights), grid,
                                    at<int32_t>(cells), n, k, static_cast<voronerf::Isa>(isa), threads);
}

}  // namespace

void bind_grid(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  // What a build has found, until Python has made tensors to copy it to.
  py::class_<voronerf::CentreGridTables>(module, "CentreGridTables")
      .def(py::init([](Address centres, Address weights, int64_t k, int isa, int threads) {
        const py::gil_scoped_release release;
        return voronerf::centre_grid_build(at<const double>(centres), at<const double>(weights), k,
                                           static_cast<voronerf::Isa>(isa), threads);
      }))
      .def_readonly("bits", &voronerf::CentreGridTables::bits)
      .def_property_readonly("sizes",
                             [](const voronerf::CentreGridTables& tables) {
                               return std::make_pair(tables.entries.size(), tables.lists.size());
                             })
      .def("copy_to", [](const voronerf::CentreGridTables& tables, Address frame, Address entries, Address lists) {
        std::copy(tables.frame, tables.frame + 6, at<float>(frame));
        std::copy(tables.entries.begin(), tables.entries.end(), at<int32_t>(entries));
        std::copy(tables.lists.begin(), tables.lists.end(), at<int32_t>(lists));
      });
  module.def("nearest_centre_grid_float32", &nearest_centre_grid<float>, no_gil);
  module.def("nearest_centre_grid_float64", &nearest_centre_grid<double>, no_gil);
}
