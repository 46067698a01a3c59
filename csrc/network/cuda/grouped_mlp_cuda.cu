// grouped_mlp on CUDA: plans calls for the device that is current, and goes the way of the plan.
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/common.h"
#include "network/cuda/grouped_mlp_cuda.h"
#include "network/cuda/grouped_mlp_cuda_layers.h"
#include "network/grouped_mlp.h"

namespace voronerf {

namespace {

MlpCudaData data_of(const MlpInputs& in) {
  MlpCudaData data{};
  data.positions = in.positions;
  data.directions = in.directions;
  data.direction_index = in.direction_index;
  data.order = in.order;
  data.offsets = in.offsets;
  data.n = in.n;
  data.k = in.k;
  data.r = in.r;
  data.encoded = in.encoded;
  return data;
}

HashEncoding grid_of(const MlpTable& table, const MlpInputs& in) {
  if (table.position.kind != MlpEncodingKind::hash) return {};
  VN_CHECK(reinterpret_cast<std::uintptr_t>(in.features) % 16 == 0,
           "grouped_mlp: the features must begin at a multiple of 16 bytes");
  const GridLevel& last = table.grid.levels.back();
  const int64_t entries = last.offset + last.entries;
  return hash_encoding({in.positions, nullptr, in.features, in.features_type, nullptr, in.n, in.tables, entries},
                       table.grid);
}

// Of any number of layers.
MlpLayersParameters layers_of(const MlpTable& table, const MlpInputs& in) {
  const size_t count = table.layers.size();
  return {{in.weights, in.weights + count}, {in.biases, in.biases + count}};
}

// Of as many as the fused kernels take.
MlpCudaParameters parameters_of(const MlpTable& table, const MlpInputs& in) {
  MlpCudaParameters parameters{};
  for (size_t l = 0; l < table.layers.size() && l < kMlpCudaLayers; ++l) {
    parameters.weights[l] = in.weights[l];
    parameters.biases[l] = in.biases[l];
  }
  return parameters;
}

}  // namespace

std::unique_ptr<MlpCudaCall> grouped_mlp_call_cuda(const MlpTable& table, int64_t n, int64_t k, bool backward,
                                                   bool parameters, MlpPrecision precision, MlpCudaWay way) {
  auto call = std::make_unique<MlpCudaCall>();
  call->table = table;
  MlpCudaChoice& choice = call->choice;
  if (const char* fault = mlp_cuda_choose(table, precision, n, k, backward, way, mlp_cuda_device(), choice)) {
    const char* callers[] = {"grouped_mlp", "grouped_linear", "routed_mlp"};
    throw std::invalid_argument(std::string(callers[static_cast<int>(table.caller)]) + ": " + fault +
                                " on CUDA; use backend='reference'");
  }
  call->workspace = choice.way == MlpCudaWay::chain   ? mlp_chain_workspace(choice.chain, k).bytes
                    : choice.way == MlpCudaWay::tiles ? mlp_cuda_workspace(choice.fused, k, parameters).bytes
                                                      : mlp_layers_workspace(choice.layers, k, parameters).bytes;
  return call;
}

int64_t grouped_mlp_workspace_cuda(const MlpCudaCall& call) { return call.workspace; }

bool grouped_mlp_hashes_cuda(const MlpTable& table, MlpPrecision precision, MlpCudaWay way) {
  return mlp_cuda_hashes(table, precision, way, mlp_cuda_device());
}

void grouped_mlp_cuda(const MlpCudaCall& call, const MlpInputs& in, float* out, unsigned char* workspace,
                      void* stream) {
  const auto& [table, choice, _] = call;
  MlpCudaData data = data_of(in);
  data.out = out;
  switch (choice.way) {
    case MlpCudaWay::chain:
      return mlp_chain_cuda(choice.chain, data, parameters_of(table, in), workspace, stream);
    case MlpCudaWay::tiles:
      return mlp_tiles_cuda(choice.fused, data, grid_of(table, in), parameters_of(table, in), workspace, stream);
    default:
      return mlp_layers_cuda(choice.layers, data, layers_of(table, in), workspace, stream);
  }
}

void grouped_mlp_backward_cuda(const MlpCudaCall& call, const MlpInputs& in, const MlpGradients& gradients,
                               unsigned char* workspace, void* stream) {
  const auto& [table, choice, _] = call;
  MlpCudaData data = data_of(in);
  data.grad_out = gradients.output;
  data.grad_positions = gradients.positions;
  data.grad_directions = gradients.directions;
  const size_t count = gradients.weights == nullptr ? 0 : table.layers.size();
  if (choice.way == MlpCudaWay::layers) {
    const MlpLayersGradients results = {{gradients.weights, gradients.weights + count},
                                        {gradients.biases, gradients.biases + count}};
    return mlp_layers_backward_cuda(choice.layers, data, layers_of(table, in), count == 0 ? nullptr : &results,
                                    workspace, stream);
  }
  if (in.n > 0 && table.position.kind == MlpEncodingKind::hash && in.encoded == nullptr) {
    throw std::invalid_argument("grouped_mlp: encoded must be what the forward pass kept of the hash grid, got none");
  }
  const HashEncoding grid = grid_of(table, in);
  data.grad_features = gradients.features;
  if (data.grad_features != nullptr) {
    const size_t bytes = sizeof(float) * static_cast<size_t>(grid.in.tables * grid.in.entries * grid.features);
    VN_CUDA_CHECK(cudaMemsetAsync(data.grad_features, 0, bytes, static_cast<cudaStream_t>(stream)));
  }
  MlpCudaParameterGradients results{};
  for (size_t l = 0; l < count && l < kMlpCudaLayers; ++l) {
    results.weights[l] = gradients.weights[l];
    results.biases[l] = gradients.biases[l];
  }
  mlp_tiles_backward_cuda(choice.fused, data, grid, parameters_of(table, in), count == 0 ? nullptr : &results,
                          workspace, stream);
}

}  // namespace voronerf
