// csrc/common/index_maps.h for test_index_maps.py.
#include "common/index_maps.h"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <tuple>
#include <vector>

namespace py = pybind11;

namespace {

using Numbers = std::vector<int64_t>;

std::tuple<int, int> of(voronerf::MapPlace place) {
  return {place.row, place.column};
}

}  // namespace

void bind_index_maps(py::module_& module) {
  using namespace voronerf;
  module.def("accumulator_place", [](int lane, int i) { return of(accumulator_place(lane, i)); });
  module.def("product_warp_tiles", &product_warp_tiles);
  module.def("product_place", [](int thread, int r, int t, int i) { return of(product_place(thread, r, t, i)); });
  module.def("fetched_word",
             [](int thread, int i, int threads, int words) { return of(fetched_word(thread, i, threads, words)); });
  module.def("gradient_tiles", &gradient_tiles);
  module.def("gradient_tile", [](int64_t block, int64_t outputs, int64_t inputs, int64_t down, int64_t across) {
    const GradientTile tile = gradient_tile(block, outputs, inputs, down, across);
    return std::make_tuple(tile.cell, tile.output, tile.input);
  });
  module.def("part_of_rows", [](int64_t begin, int64_t end, int64_t part, int64_t parts, int64_t step) {
    const RowRange range = part_of_rows(begin, end, part, parts, step);
    return std::make_tuple(range.begin, range.end);
  });
  module.def("last_not_above", [](const std::vector<int32_t>& values, int64_t count, int64_t value) {
    return last_not_above(values.data(), count, value);
  });
  module.def("first_above", [](const std::vector<uint16_t>& values, int64_t value) {
    return first_above(values.data(), static_cast<int64_t>(values.size()), value);
  });
  module.def("column_of_packed", [](const Numbers& widths, const Numbers& padded, int64_t packed) {
    return column_of_packed(widths.data(), padded.data(), static_cast<int>(widths.size()), packed);
  });
  module.def("packed_of_column", [](const Numbers& widths, const Numbers& padded, int64_t column) {
    return packed_of_column(widths.data(), padded.data(), static_cast<int>(widths.size()), column);
  });
  module.def("bucket_of_cell", &bucket_of_cell);
}
