// grouped_mlp layer by layer on CUDA, forward and backward: for every slab of rows the encodings, then a product a
// layer, and back; see grouped_mlp_cuda_layers.h. A layer's gradient replaces its values, which by then have entered
// the gradients of the weights that read them.
#include <algorithm>

#include "network/cuda/grouped_mlp_cuda_layers_epilogue.h"
#include "network/cuda/grouped_mlp_cuda_product.h"
#include "network/cuda/grouped_mlp_cuda_tasks.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kBlocksPerMultiprocessor = 8;  // of kernels that walk over their elements

// What the kernels of one layer need of its table.
struct PackedSources {
  int64_t width[kLayersParts], padded[kLayersParts];
  int count;
};
PackedSources packed_sources(const MlpLayersLayer& layer) {
  PackedSources sources{};
  sources.count = static_cast<int>(layer.sources.size());
  for (int s = 0; s < sources.count; ++s) {
    sources.width[s] = layer.sources[s].width;
    sources.padded[s] = layer.sources[s].padded;
  }
  return sources;
}

// [k][width][inputs] rounded into [k][padded][stride], what is between cleared.
template <typename Products>
__global__ void __launch_bounds__(kThreads)
    layers_pack_kernel(const float* weight, typename Products::Element* to, const PackedSources sources, int64_t k,
                       int64_t width, int64_t inputs, int64_t padded, int64_t stride) {
  const int64_t pairs = k * padded * stride / 2, step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < pairs; i += step) {
    const int64_t line = 2 * i / stride, cell = line / padded, row = line - cell * padded;
    float values[2] = {0.0f, 0.0f};
    for (int part = 0; part < 2; ++part) {
      const int64_t column =
          column_of_packed(sources.width, sources.padded, sources.count, 2 * i - line * stride + part);
      if (row < width && column >= 0) values[part] = weight[(cell * width + row) * inputs + column];
    }
    Products::store(to + 2 * i, values[0], values[1]);
  }
}

// One block: the tiles of every cell in the slab, numbered.
__global__ void __launch_bounds__(kScanThreads)
    layers_tasks_kernel(const MlpSlab slab, int32_t* first_task, int64_t most) {
  number_tasks<kScanThreads>(slab.k, most, first_task, [&](int64_t cell) {
    const MlpRows rows = mlp_slab_rows(slab, cell);
    return static_cast<int32_t>(ceil_div<int64_t>(rows.end - rows.begin, kLayersRows));
  });
}

// Raw features of a row of the slab.
struct RawRows {
  const float* raw;
  const int32_t *order, *index;
  int64_t first, directions;  // rows that an index counts
  int features;

  __device__ int64_t sample(int64_t row) const { return order == nullptr ? first + row : order[first + row]; }
  __device__ const float* at(int64_t row) const {
    const int64_t source = sample(row);
    return raw + (index == nullptr ? source : mlp_within(index[source], directions)) * features;
  }
};

template <typename Products>
__global__ void __launch_bounds__(kThreads)
    layers_encode_kernel(const MlpCudaInput input, const RawRows rows, int64_t count, typename Products::Element* to) {
  const int64_t half = input.padded / 2, pairs = count * half, step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < pairs; i += step) {
    const int64_t row = i / half;
    const int column = static_cast<int>(2 * (i - row * half));
    const float* raw = rows.at(row);
    Products::store(to + 2 * i, mlp_encoded(input, raw, column), mlp_encoded(input, raw, column + 1));
  }
}

// Gradients of raw features from those of their encoding, rows of cells alone.
template <typename Products>
__global__ void __launch_bounds__(kThreads)
    layers_encode_backward_kernel(const MlpCudaInput input, const RawRows rows, const MlpSlab slab,
                                  const typename Products::Element* gradients, float* results) {
  const int features = input.integrated ? input.raw / 2 : input.raw;
  const int64_t low = slab.offsets[0] - slab.first, high = slab.offsets[slab.k] - slab.first;
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < slab.rows * features; i += step) {
    const int64_t row = i / features;
    if (row < low || row >= high) continue;
    mlp_encode_gradient<Products>(input, gradients + row * input.padded, rows.at(row),
                                  static_cast<int>(i - row * features), results + rows.sample(row) * input.raw);
  }
}

// Sums the parts of a layer's gradients, [splits][k] of them; a layer that is not live has none.
__global__ void __launch_bounds__(kThreads)
    layers_reduce_kernel(const float* partials, const PackedSources sources, float* weights, float* biases, int64_t k,
                         int64_t width, int64_t inputs, int64_t padded, int64_t stride, int64_t partial, int splits) {
  const int64_t columns = inputs + (biases == nullptr ? 0 : 1), step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < k * width * columns; i += step) {
    const int64_t line = i / columns, column = i - line * columns, cell = line / width, row = line - cell * width;
    int64_t at = padded * stride + row;  // of a bias
    if (column < inputs) {
      at = row * stride + packed_of_column(sources.width, sources.padded, sources.count, column);
    }
    float sum = 0.0f;
    for (int split = 0; split < splits; ++split) sum += partials[(split * k + cell) * partial + at];
    (column < inputs ? weights[line * inputs + column] : biases[line]) = sum;
  }
}

// A call: its plan, where its parts lie, and the launches.
template <typename Products>
class Call {
 public:
  using Element = typename Products::Element;

  Call(const MlpLayersPlan& plan, const MlpCudaData& data, const MlpLayersParameters& parameters,
       unsigned char* workspace, bool gradients, void* stream)
      : plan_(plan), data_(data), parameters_(parameters), stream_(stream) {
    const MlpLayersWorkspace parts = mlp_layers_workspace(plan, data.k, gradients);
    packed_ = reinterpret_cast<Element*>(workspace + parts.packed);
    first_task_ = reinterpret_cast<int32_t*>(workspace + parts.first_task);
    values_ = reinterpret_cast<Element*>(workspace + parts.values);
    partials_ = gradients ? reinterpret_cast<float*>(workspace + parts.partials) : nullptr;
    for (size_t l = 0; l < plan.layers.size(); ++l) {
      const MlpLayersLayer& layer = plan.layers[l];
      if (!layer.live) continue;
      VN_LAUNCH((layers_pack_kernel<Products>), blocks_for(data.k * layer.padded * layer.stride / 2), kThreads, 0,
                stream, parameters.weights[l], packed_ + layer.weight, packed_sources(layer), data.k, layer.width,
                layer.inputs, layer.padded, layer.stride);
    }
  }

  // The slab that begins at row `first`: its tasks, encodings and values.
  void forward(int64_t first, float* out) {
    const int64_t rows = data_.n - first < plan_.slab ? data_.n - first : plan_.slab;
    slab_ = {data_.offsets, first_task_, data_.n, data_.k, first, rows};
    VN_LAUNCH(layers_tasks_kernel, 1, kScanThreads, 0, stream_, slab_, first_task_, plan_.tiles);
    for (const int from : {kFromPositions, kFromDirections}) {
      const MlpCudaInput& input = plan_.input(from);
      if (!input.used) continue;
      VN_LAUNCH((layers_encode_kernel<Products>), blocks_for(rows * input.padded / 2), kThreads, 0, stream_, input,
                raw(from), rows, place(input.value));
    }
    for (size_t l = 0; l < plan_.layers.size(); ++l) {
      const MlpLayersLayer& layer = plan_.layers[l];
      if (!layer.live) continue;
      MlpParts parts{};
      parts.columns = layer.padded;
      for (const MlpLayersSource& source : layer.sources) {
        parts.parts[parts.count++] = {value_of(source.from), weights_of(layer, source),   source.padded,
                                      layer.stride,          layer.padded * layer.stride, source.padded};
      }
      LayersForward<Products> finish{};
      finish.bias = parameters_.biases[l];
      finish.value = place(layer.value);
      finish.slope = layer.slope < 0 ? nullptr : place(layer.slope);
      finish.out = layer.outputs.empty() ? nullptr : out;
      outside(layer, finish);
      VN_LAUNCH((mlp_product_kernel<Products, false, LayersForward<Products>>), grid(layer.padded), kLayersThreads,
                MlpChunk<Element>::kBytes, stream_, slab_, parts, finish);
    }
  }

  // The slab's gradients; forward() has left the values.
  void backward() {
    for (int l = static_cast<int>(plan_.layers.size()) - 1; l >= 0; --l) {
      const MlpLayersLayer& layer = plan_.layers[l];
      if (!layer.live) continue;
      gather(l, layer, layer.slope < 0 ? layer.value : layer.slope, layer.activation);
      if (partials_ != nullptr) weight_gradients(layer);
    }
    const struct {
      int from;
      float* results;
    } wanted[] = {{kFromPositions, data_.grad_positions}, {kFromDirections, data_.grad_directions}};
    for (const auto& [from, results] : wanted) {
      const MlpCudaInput& input = plan_.input(from);
      if (results == nullptr || !input.used) continue;
      MlpLayersLayer alone{};
      alone.width = input.width;
      alone.padded = input.padded;
      alone.value = input.value;
      gather(from, alone, input.value, static_cast<int>(Activation::none));
      const int64_t features = input.integrated ? input.raw / 2 : input.raw;
      VN_LAUNCH((layers_encode_backward_kernel<Products>), blocks_for(slab_.rows * features), kThreads, 0, stream_,
                input, raw(from), slab_, place(input.value), results);
    }
  }

  void reduce(const MlpLayersGradients& gradients) {
    for (size_t l = 0; l < plan_.layers.size(); ++l) {
      const MlpLayersLayer& layer = plan_.layers[l];
      VN_LAUNCH(layers_reduce_kernel, blocks_for(data_.k * layer.width * (layer.inputs + 1)), kThreads, 0, stream_,
                partials_ + layer.partial, packed_sources(layer), gradients.weights[l], gradients.biases[l], data_.k,
                layer.width, layer.inputs, layer.padded, layer.stride, plan_.partial,
                layer.live && data_.n > 0 ? plan_.splits : 0);
    }
  }

 private:
  const MlpLayersPlan& plan_;
  const MlpCudaData& data_;
  const MlpLayersParameters& parameters_;
  void* stream_;
  Element *packed_, *values_;
  int32_t* first_task_;
  float* partials_;
  MlpSlab slab_{};

  unsigned blocks_for(int64_t elements) const {
    const int64_t most = int64_t{kBlocksPerMultiprocessor} * plan_.multiprocessors;
    return static_cast<unsigned>(std::min(ceil_div<int64_t>(elements, kThreads), most));
  }
  Element* place(int64_t column) const { return values_ + column * plan_.slab; }
  int64_t padded_of(int from) const { return from >= 0 ? plan_.layers[from].padded : plan_.input(from).padded; }
  Element* value_of(int from) const { return place(from >= 0 ? plan_.layers[from].value : plan_.input(from).value); }
  const Element* weights_of(const MlpLayersLayer& layer, const MlpLayersSource& source) const {
    return packed_ + layer.weight + source.packed;
  }
  dim3 grid(int64_t columns) const {
    return dim3(static_cast<unsigned>(plan_.tiles), static_cast<unsigned>(ceil_div<int64_t>(columns, kLayersColumns)));
  }

  RawRows raw(int from) const {
    if (from == kFromPositions) return {data_.positions, data_.order, nullptr, slab_.first, 0, plan_.positions.raw};
    return {data_.directions, data_.order, data_.direction_index, slab_.first, data_.r, plan_.directions.raw};
  }

  template <typename Finish>
  void outside(const MlpLayersLayer& layer, Finish& finish) const {
    finish.order = data_.order;
    finish.first = slab_.first;
    finish.out_features = plan_.out_features;
    finish.width = layer.width;
    finish.padded = layer.padded;
    finish.activation = layer.activation;
    finish.outputs = static_cast<int>(layer.outputs.size());
    for (int o = 0; o < finish.outputs; ++o) finish.columns[o] = layer.outputs[o];
  }

  // The gradient of a value, from all layers that read it.
  void gather(int from, const MlpLayersLayer& layer, int64_t slope, int activation) {
    MlpParts parts{};
    parts.columns = layer.padded;
    for (const MlpLayersLayer& reader : plan_.layers) {
      if (!reader.live) continue;
      for (const MlpLayersSource& source : reader.sources) {
        if (source.from != from) continue;
        parts.parts[parts.count++] = {place(reader.value), weights_of(reader, source),    reader.padded,
                                      reader.stride,       reader.padded * reader.stride, reader.padded};
      }
    }
    LayersBackward<Products> finish{};
    finish.value = place(layer.value);
    finish.slope = place(slope);
    finish.grad_out = data_.grad_out;
    outside(layer, finish);
    finish.activation = activation;
    VN_LAUNCH((mlp_product_kernel<Products, true, LayersBackward<Products>>), grid(layer.padded), kLayersThreads,
              MlpChunk<Element>::kBytes, stream_, slab_, parts, finish);
  }

  void weight_gradients(const MlpLayersLayer& layer) {
    for (const MlpLayersSource& source : layer.sources) {
      MlpWeightGradient to{};
      to.gradients = place(layer.value);
      to.values = value_of(source.from);
      to.gradient_stride = layer.padded;
      to.value_stride = padded_of(source.from);
      to.outputs = layer.padded;
      to.inputs = source.padded;
      to.k = data_.k;
      to.weights = partials_ + layer.partial + source.packed;
      to.biases = source.packed == 0 ? partials_ + layer.partial + layer.padded * layer.stride : nullptr;
      to.stride = layer.stride;
      to.cell = plan_.partial;
      to.splits = plan_.splits;
      to.first = slab_.first == 0;
      const int64_t tiles = gradient_tiles(to.outputs, to.inputs, kLayersRows, kLayersColumns) * data_.k;
      VN_LAUNCH((mlp_weight_gradient_kernel<Products>), dim3(static_cast<unsigned>(tiles), plan_.splits),
                kLayersThreads, MlpChunk<Element>::kBytes, stream_, slab_, to);
    }
  }
};

template <typename Products>
void run(const MlpLayersPlan& plan, const MlpCudaData& data, const MlpLayersParameters& parameters,
         const MlpLayersGradients* gradients, unsigned char* workspace, void* stream) {
  Call<Products> call(plan, data, parameters, workspace, gradients != nullptr, stream);
  for (int64_t first = 0; first < data.n; first += plan.slab) {
    call.forward(first, data.out);
    if (plan.backward) call.backward();
  }
  if (gradients != nullptr) call.reduce(*gradients);
}

void run(const MlpLayersPlan& plan, const MlpCudaData& data, const MlpLayersParameters& parameters,
         const MlpLayersGradients* gradients, unsigned char* workspace, void* stream) {
  mlp_with_products(plan.precision, [&](auto products) {
    run<decltype(products)>(plan, data, parameters, gradients, workspace, stream);
  });
}

}  // namespace

void mlp_layers_cuda(const MlpLayersPlan& plan, const MlpCudaData& data, const MlpLayersParameters& parameters,
                     unsigned char* workspace, void* stream) {
  if (data.n == 0) return;
  mlp_cuda_zero_strays(data, static_cast<int>(plan.out_features), data.out, stream);
  run(plan, data, parameters, nullptr, workspace, stream);
}

void mlp_layers_backward_cuda(const MlpLayersPlan& plan, const MlpCudaData& data, const MlpLayersParameters& parameters,
                              const MlpLayersGradients* gradients, unsigned char* workspace, void* stream) {
  mlp_cuda_clear_gradient(data, plan.positions.used, plan.positions.raw, data.grad_positions, stream);
  mlp_cuda_clear_gradient(data, plan.directions.used, plan.directions.raw, data.grad_directions, stream);
  run(plan, data, parameters, gradients, workspace, stream);
}

}  // namespace voronerf
