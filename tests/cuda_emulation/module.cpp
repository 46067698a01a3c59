// The CUDA half of voronerf.ops._core._C, emulated: the bindings of csrc/bindings over .cu files compiled by g++.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/grouped_mlp.h"
#include "emulation.h"
#include "geometry/cell_sort.h"
#include "network/cuda/grouped_mlp_cuda_layers.h"

namespace py = pybind11;

namespace vn_emulation {
int64_t launches();
}
void bind_index_maps(py::module_& module);
void bind_plans(py::module_& module);
void bind_chain_layout(py::module_& module);
void planted(const float* values, float* out, int* counter, int blocks, int threads, int bug);

PYBIND11_MODULE(voronerf_emulation, module) {
  voronerf::bind_all(module.ptr());
  bind_index_maps(module);
  bind_plans(module);
  bind_chain_layout(module);
  module.def("planted",
             [](std::uintptr_t values, std::uintptr_t out, std::uintptr_t counter, int blocks, int threads, int bug) {
               planted(reinterpret_cast<const float*>(values), reinterpret_cast<float*>(out),
                       reinterpret_cast<int*>(counter), blocks, threads, bug);
             });
  // What a call's plan says.
  module.def(
      "grouped_mlp_plan",
      [](const py::object& table, int precision, int64_t n, int64_t k, bool backward, int way) {
        voronerf::MlpCudaChoice choice;
        const char* fault = voronerf::mlp_cuda_choose(voronerf::struct_of<voronerf::MlpTable>(table.ptr()), static_cast<voronerf::MlpPrecision>(precision), n, k,
                                                      backward, static_cast<voronerf::MlpCudaWay>(way),
                                                      voronerf::mlp_cuda_device(), choice);
        VN_CHECK(fault == nullptr, fault);
        py::dict plan;
        const bool by_layers = choice.way == voronerf::MlpCudaWay::layers;
        plan["way"] = static_cast<int>(choice.way);
        plan["by_layers"] = by_layers;
        plan["precision"] = static_cast<int>(by_layers ? choice.layers.precision : choice.fused.precision);
        plan["task_rows"] = choice.fused.task_rows;
        plan["tasks"] = choice.fused.tasks;
        plan["slabs"] = choice.layers.slabs;
        plan["splits"] = choice.layers.splits;
        plan["partial_bytes"] = 4 * k * choice.layers.partial;
        plan["workspace"] = voronerf::mlp_layers_workspace(choice.layers, k, backward).bytes;
        return plan;
      },
      py::arg("table"), py::arg("precision"), py::arg("n"), py::arg("k"), py::arg("backward"), py::arg("way") = 0);
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
