// march_rays and update_occupancy for Python: addresses and sizes in, the GIL released while it runs.
#include "bindings/bindings_march.h"

#include <pybind11/stl.h>

#include <cstdint>
#include <vector>

#include "common/common.h"
#include "rays/march_rays.h"
#include "rays/update_occupancy.h"

namespace py = pybind11;

namespace {

using Address = std::uintptr_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

// inputs: origins, directions, near, far, occupied, box, uniforms, start; the last two may be 0. sizes: r, s, x, y, z,
// whether the spacing is that of disparity, most.
voronerf::MarchInputs read_inputs(const std::vector<Address>& inputs, const std::vector<int64_t>& sizes) {
  VN_CHECK(inputs.size() == 8 && sizes.size() == 7, "march_rays: arguments missing");
  const auto read = [&](size_t i) { return at<const float>(inputs[i]); };
  return {read(0),
          read(1),
          read(2),
          read(3),
          at<const uint8_t>(inputs[4]),
          read(5),
          read(6),
          at<const int32_t>(inputs[7]),
          sizes[0],
          sizes[1],
          {sizes[2], sizes[3], sizes[4]},
          sizes[5] != 0,
          sizes[6]};
}

void march_rays_count(const std::vector<Address>& inputs, const std::vector<int64_t>& sizes, Address mask,
                      Address offsets, int64_t capacity, int isa, int threads) {
  voronerf::march_rays_count_cpu(read_inputs(inputs, sizes), at<uint32_t>(mask), at<int32_t>(offsets), capacity,
                                 static_cast<voronerf::Isa>(isa), threads);
}

void march_rays_fill(const std::vector<Address>& inputs, const std::vector<int64_t>& sizes, Address mask,
                     Address offsets, int64_t rows, Address ray_index, Address depths, Address deltas,
                     Address positions, Address stop, int isa, int threads) {
  voronerf::march_rays_fill_cpu(read_inputs(inputs, sizes), at<const uint32_t>(mask), at<const int32_t>(offsets), rows,
                                at<int32_t>(ray_index), at<float>(depths), at<float>(deltas), at<float>(positions),
                                at<int32_t>(stop), static_cast<voronerf::Isa>(isa), threads);
}

bool update_occupancy(Address density, Address rows, Address values, Address result, Address occupied, int64_t n,
                      int64_t q, float decay, float threshold, int threads) {
  return voronerf::update_occupancy_cpu(at<const float>(density), at<const int32_t>(rows), at<const float>(values),
                                        at<float>(result), at<uint8_t>(occupied), n, q, decay, threshold, threads);
}

}  // namespace

void bind_march(py::module_& module) {
  const auto no_gil = py::call_guard<py::gil_scoped_release>();
  module.def("march_words", &voronerf::march_words);
  module.def("march_rays_count", &march_rays_count, no_gil);
  module.def("march_rays_fill", &march_rays_fill, no_gil);
  module.def("update_occupancy", &update_occupancy, no_gil);
}
