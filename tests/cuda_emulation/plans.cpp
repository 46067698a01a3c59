// The plans of grouped_mlp as pure functions, for test_plans.py: for a device that is described, not asked.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <vector>

#include "bindings/grouped_mlp.h"
#include "network/cuda/grouped_mlp_cuda_layers.h"

namespace py = pybind11;

namespace {

// Capability, shared memory of a block, multiprocessors and bytes of cache.
using Device = std::vector<int64_t>;

py::dict plan_for(const py::object& table, int precision, int64_t n, int64_t k, bool backward,
                  const Device& given) {
  const voronerf::MlpCudaDevice device{static_cast<int>(given[0]), static_cast<int>(given[1]),
                                       static_cast<int>(given[2]), given[3]};
  voronerf::MlpCudaChoice choice;
  const char* fault =
      voronerf::mlp_cuda_choose(voronerf::struct_of<voronerf::MlpTable>(table.ptr()), static_cast<voronerf::MlpPrecision>(precision), n, k,
                                backward, voronerf::MlpCudaWay::automatic, device, choice);
  if (fault != nullptr) throw std::runtime_error(fault);
  py::dict plan;
  plan["by_layers"] = choice.way == voronerf::MlpCudaWay::layers;
  plan["chained"] = choice.way == voronerf::MlpCudaWay::chain;
  if (choice.way == voronerf::MlpCudaWay::chain) {
    const voronerf::MlpChainPlan& chain = choice.chain;
    const voronerf::MlpCudaWorkspace parts = voronerf::mlp_chain_workspace(chain, k);
    plan["precision"] = static_cast<int>(chain.precision);
    plan["shared_bytes"] = chain.shared_bytes;
    plan["threads"] = 32 * chain.warps;
    plan["task_rows"] = chain.task_rows;
    plan["block_rows"] = chain.rows();
    plan["grid"] = std::vector<int64_t>{chain.tasks, 1, 1};
    plan["starts"] = std::vector<int64_t>{parts.packed, parts.first_task};
    plan["sizes"] = std::vector<int64_t>{chain.packed_bytes * k, 4 * (k + 1)};
    plan["bytes"] = parts.bytes;
    return plan;
  }
  if (choice.way == voronerf::MlpCudaWay::tiles) {
    const voronerf::MlpCudaPlan& fused = choice.fused;
    const voronerf::MlpCudaWorkspace parts = voronerf::mlp_cuda_workspace(fused, k, backward);
    plan["precision"] = static_cast<int>(fused.precision);
    plan["shared_bytes"] = fused.shared_bytes;
    plan["threads"] = 32 * fused.warps;
    plan["task_rows"] = fused.task_rows;
    plan["block_rows"] = fused.rows();
    plan["grid"] = std::vector<int64_t>{fused.tasks, 1, 1};
    plan["starts"] = std::vector<int64_t>{parts.packed, parts.first_task, parts.partials};
    plan["sizes"] = std::vector<int64_t>{fused.packed_bytes * k, 4 * (k + 1),
                                         backward ? 4 * fused.tasks * int64_t{fused.partial} : 0};
    plan["bytes"] = parts.bytes;
    return plan;
  }
  const voronerf::MlpLayersPlan& layers = choice.layers;
  const voronerf::MlpLayersWorkspace parts = voronerf::mlp_layers_workspace(layers, k, backward);
  int64_t widest = 1, gradient_tiles = 1;
  for (const auto& layer : layers.layers) {
    widest = std::max(widest, layer.padded);
    for (const auto& source : layer.sources) {
      gradient_tiles =
          std::max(gradient_tiles, k * ((layer.padded + voronerf::kLayersRows - 1) / voronerf::kLayersRows) *
                                       ((source.padded + voronerf::kLayersColumns - 1) / voronerf::kLayersColumns));
    }
  }
  plan["precision"] = static_cast<int>(layers.precision);
  plan["slab"] = layers.slab;
  plan["slabs"] = layers.slabs;
  plan["values"] = layers.columns * layers.element * layers.slab;
  plan["row_bytes"] = layers.columns * layers.element;
  plan["grid"] = std::vector<int64_t>{
      std::max(layers.tiles, gradient_tiles),
      std::max<int64_t>(layers.splits, (widest + voronerf::kLayersColumns - 1) / voronerf::kLayersColumns), 1};
  plan["tiles"] = layers.tiles;
  plan["starts"] = std::vector<int64_t>{0, parts.first_task, parts.values, parts.partials};
  plan["sizes"] =
      std::vector<int64_t>{layers.packed * layers.element, 4 * (k + 1), layers.columns * layers.element * layers.slab,
                           backward ? 4 * int64_t{layers.splits} * k * layers.partial : 0};
  plan["bytes"] = parts.bytes;
  return plan;
}

}  // namespace

void bind_plans(py::module_& module) {
  module.def("plan_for", &plan_for);
}
