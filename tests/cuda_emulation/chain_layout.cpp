// The plan and the layouts of the chained network for the tests.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings/grouped_mlp.h"
#include "emulation.h"
#include "encoding/encode_math.h"
#include "network/cuda/grouped_mlp_cuda_chain.h"

namespace py = pybind11;

namespace {

py::dict source_of(const voronerf::MlpChainPlan& plan, const voronerf::MlpChainSource& source) {
  py::dict told;
  told["from"] = static_cast<int>(source.from);
  told["region"] = source.region;
  told["compute"] = source.compute;
  told["column"] = source.column;
  std::vector<int> features;
  for (int column = 0; column < source.steps * voronerf::kChainStep; ++column) {
    features.push_back(voronerf::chain_source_feature(plan, source, column));
  }
  told["features"] = features;
  return told;
}

py::dict layer_of(const voronerf::MlpChainPlan& plan, const voronerf::MlpChainLayer& layer) {
  py::dict told;
  told["index"] = layer.index;
  told["piece"] = layer.piece;
  told["region"] = layer.region;
  told["held"] = layer.held;
  told["among"] = layer.among;
  py::list sources, pieces;
  for (int s = 0; s < layer.source_count; ++s) sources.append(source_of(plan, layer.sources[s]));
  for (int chunk = 0; chunk < voronerf::chain_chunks(layer.width); ++chunk) {
    const int pairs = voronerf::chain_pairs(voronerf::chain_tiles(layer.width, chunk, layer.fresh));
    pieces.append(py::make_tuple(16 * pairs, voronerf::chain_piece_bytes(layer.steps, pairs)));
  }
  told["sources"] = sources;
  told["pieces"] = pieces;
  return told;
}

}  // namespace

void bind_chain_layout(py::module_& module) {
  module.def("turns_of_large", voronerf::turns_of_large);
  module.def("chain_weight_place", voronerf::chain_weight_place);
  module.def("chain_weight_output", voronerf::chain_weight_output);
  module.def("chain_weight_column", voronerf::chain_weight_column);
  // The plan of a table, or the rule that it breaks.
  module.def("chain_plan",
             [](const py::object& table, int precision, int64_t n, int64_t k, int capability,
                int shared_bytes, int multiprocessors) -> py::object {
               voronerf::MlpChainPlan plan;
               const voronerf::MlpCudaDevice device = {capability, shared_bytes, multiprocessors, 1 << 20};
               const char* fault =
                   voronerf::mlp_chain_plan(voronerf::struct_of<voronerf::MlpTable>(table.ptr()),
                                            static_cast<voronerf::MlpPrecision>(precision), n, k, device, plan);
               if (fault != nullptr) return py::str(fault);
               py::dict told;
               told["width"] = plan.width;
               told["warps"] = plan.warps;
               told["resident"] = plan.resident;
               told["slot"] = plan.slot;
               told["weights"] = plan.weights;
               told["region"] = plan.region;
               told["shared_bytes"] = plan.shared_bytes;
               told["pieces"] = plan.pieces;
               told["packed_bytes"] = plan.packed_bytes;
               py::list layers;
               for (int l = 0; l < plan.layer_count; ++l) layers.append(layer_of(plan, plan.layers[l]));
               told["layers"] = layers;
               return told;
             });
}
