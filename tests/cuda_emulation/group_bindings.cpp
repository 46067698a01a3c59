// Products of a group of four warps for the tests.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "network/cuda/cuda_wgmma.h"
#include "group_product.h"

namespace py = pybind11;

static_assert(voronerf::group_descriptor(0x12340, 128, 256) == 0x0000001000081234u, "fields of a descriptor");

void bind_groups(py::module_& module) {
  module.def("group_descriptor", voronerf::group_descriptor);
  module.def("group_product", [](std::uintptr_t a, std::uintptr_t packed, std::uintptr_t out,
                                 const std::vector<int>& sizes, int threads, int tiles, bool bfloat16, int bug) {
    const GroupProductCase given = {reinterpret_cast<const uint16_t*>(a),
                                    reinterpret_cast<const unsigned char*>(packed),
                                    reinterpret_cast<float*>(out),
                                    sizes[0],
                                    sizes[1],
                                    sizes[2],
                                    static_cast<uint32_t>(sizes[3]),
                                    static_cast<uint32_t>(sizes[4]),
                                    bug};
    group_product(given, threads, tiles, bfloat16);
  });
}
