// The emulated CUDA half of voronerf.ops._core._C: the bindings of csrc/bindings for .cu files compiled by g++.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/bind.h"
#include "emulation.h"
#include "geometry/cell_sort.h"

namespace py = pybind11;

namespace vn_emulation {
int64_t launches();
}
void bind_index_maps(py::module_& module);
void planted(const float* values, float* out, int* counter, int blocks, int threads, int bug);

PYBIND11_MODULE(voronerf_emulation, module) {
  voronerf::bind_all(module.ptr());
  bind_index_maps(module);
  module.def("planted",
             [](std::uintptr_t values, std::uintptr_t out, std::uintptr_t counter, int blocks, int threads, int bug) {
               planted(reinterpret_cast<const float*>(values), reinterpret_cast<float*>(out),
                       reinterpret_cast<int*>(counter), blocks, threads, bug);
             });
  module.def("cell_sort_plan", [](int64_t n, int64_t k, int way, int64_t temporary) {
    const voronerf::CellSortPlan found =
        voronerf::cell_sort_plan(n, k, static_cast<voronerf::CellSortWay>(way), temporary);
    py::dict plan;
    plan["radix"] = found.radix;
    plan["chunks"] = found.chunks;
    plan["chunk_rows"] = found.chunk_rows;
    plan["tiles"] = found.tiles;
    plan["bits"] = found.bits;
    plan["key_bytes"] = found.key_bytes;
    plan["parts"] = found.radix ? std::vector<int64_t>{found.keys, found.sorted, found.rows, found.temporary}
                                : std::vector<int64_t>{found.counts, found.tile_sums};
    plan["bytes"] = found.bytes;
    return plan;
  });
  module.def("launches", &vn_emulation::launches);
  // Calls call(name, grid, block, shared bytes, bytes of the arguments) after each launch, until the next `watch`.
  module.def("watch", [](const py::object& call) {
    vn_emulation::watcher() = nullptr;
    if (call.is_none()) return;
    vn_emulation::watcher() = [call](const char* name, dim3 grid, dim3 block, size_t shared, const std::string& bytes) {
      const py::gil_scoped_acquire held;
      call(name, grid.x, block.x, shared, py::bytes(bytes));
    };
  });
  module.def("seed", [](uint64_t seed) { vn_emulation::settings().seed = seed; });
  module.def("device", [](int capability, int compiled, int shared_bytes) {
    ++vn_emulation::settings().device;
    vn_emulation::settings().capability = capability;
    vn_emulation::settings().compiled = compiled;
    vn_emulation::settings().shared = shared_bytes;
  });
  module.def("current", [] { return vn_emulation::settings().device; });
  module.def("multiprocessors", [](int count) {
    ++vn_emulation::settings().device;
    vn_emulation::settings().multiprocessors = count;
  });
}
