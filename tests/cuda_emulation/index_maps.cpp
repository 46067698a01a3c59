// Bindings of csrc/common/index_maps.h for test_index_maps.py.
#include "common/index_maps.h"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <tuple>
#include <vector>

namespace py = pybind11;

namespace {

std::tuple<int, int> of(voronerf::MapPlace place) {
  return {place.row, place.column};
}

}  // namespace

void bind_index_maps(py::module_& module) {
  using namespace voronerf;
  module.def("accumulator_place", [](int lane, int i) { return of(accumulator_place(lane, i)); });
  module.def("wave_place", [](int octaves, int features, int raw, int i) {
    return wave_place({octaves, features, raw}, i);
  });
  module.def("wave_column", [](int octaves, int features, int raw, int i) {
    return wave_column({octaves, features, raw}, i);
  });
  module.def("last_not_above", [](const std::vector<int32_t>& values, int64_t count, int64_t value) {
    MapSpan span{0, count};
    while (span.last - span.first > 1) {
      int votes = 0;
      for (int lane = 0; lane < 32; ++lane) {
        const int64_t at = probed(span, lane);
        votes += at < span.last && values[static_cast<size_t>(at)] <= value;
      }
      span = narrowed(span, votes);
    }
    return span.first;
  });
  module.def("first_above", [](const std::vector<uint16_t>& values, int64_t value) {
    return first_above(values.data(), static_cast<int64_t>(values.size()), value);
  });
  module.def("bucket_of_cell", &bucket_of_cell);
}
