// What grouped_mlp does before and after its rows on CUDA. In one launch every cell's weights are rounded and packed as
// the kernels want them in shared memory, so that loading them there is one straight copy; the tasks of all cells are
// numbered, so that a block finds its rows without the host having read the offsets; and rows of no cell are cleared.
// The partial weight gradients of a cell's tasks are summed in an order that the offsets alone say, which makes them
// the same every time.
#include <algorithm>

#include "network/cuda/grouped_mlp_cuda_tasks.h"

namespace voronerf {

namespace {

constexpr int kThreads = kMlpLayerThreads;
constexpr int64_t kBlocksPerMultiprocessor = 8;  // of kernels with blocks for each cell
constexpr int kManyPartials = 16;                // of a cell, which the warps of a block then share

// Grid (k, layers, blocks of a layer).
template <typename Products>
__global__ void __launch_bounds__(kThreads)
    mlp_pack_kernel(const MlpCudaPlan plan, const MlpCudaData data, const MlpCudaParameters parameters,
                    const MlpStrays strays) {
  using Element = typename Products::Element;
  if (blockIdx.y == 0) mlp_prepare_rows(data, plan.task_rows, plan.tasks, strays);
  const int64_t cell = blockIdx.x;
  const MlpCudaLayer& layer = plan.layers[blockIdx.y];
  unsigned char* packed = data.packed + cell * plan.packed_bytes;
  Element* to = reinterpret_cast<Element*>(packed) + layer.weight;
  float* biases = reinterpret_cast<float*>(packed + sizeof(Element) * plan.packed_weights) + layer.bias;
  const float* weight = parameters.weights[blockIdx.y] + cell * layer.width * layer.inputs;
  const float* bias = parameters.biases[blockIdx.y];
  const int pairs = layer.weight_stride / 2;
  const int thread = blockIdx.z * kThreads + threadIdx.x, step = gridDim.z * kThreads;
  for (int i = thread; i < layer.padded * pairs; i += step) {
    const int row = i / pairs, column = 2 * (i - row * pairs);
    float values[2] = {0.0f, 0.0f};
    for (int s = 0; s < layer.source_count; ++s) {
      const MlpCudaSource& source = layer.sources[s];
      for (int part = 0; part < 2; ++part) {
        const int feature = column + part - source.packed;
        if (row < layer.width && feature >= 0 && feature < source.width) {
          values[part] = weight[row * layer.inputs + source.column + feature];
        }
      }
    }
    Products::store(to + row * layer.weight_stride + column, values[0], values[1]);
  }
  for (int i = thread; i < layer.padded; i += step) {
    biases[i] = bias == nullptr || i >= layer.width ? 0.0f : bias[cell * layer.width + i];
  }
}

// One block.
__global__ void __launch_bounds__(kScanThreads)
    mlp_tasks_kernel(const MlpCudaData data, int64_t task_rows, int64_t tasks) {
  mlp_number_tasks<kScanThreads>(data, task_rows, tasks);
}

__global__ void __launch_bounds__(kThreads) mlp_strays_kernel(const MlpCudaData data, int width, float* rows) {
  const int64_t first = data.offsets[0], last = data.offsets[data.k];
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < data.n; i += step) {
    if (i >= first && i < last) continue;
    const int64_t row = mlp_within(mlp_source_row(data, i), data.n);  // a program's order is its caller's
    for (int column = 0; column < width; ++column) rows[row * width + column] = 0.0f;
  }
}

// Grid (k, layers, blocks of a layer).
__global__ void __launch_bounds__(kThreads)
    mlp_reduce_kernel(const MlpCudaPlan plan, const MlpCudaData data, const MlpCudaParameterGradients gradients) {
  const int64_t cell = blockIdx.x;
  const MlpCudaLayer& layer = plan.layers[blockIdx.y];
  const int64_t first = data.first_task[cell], last = layer.live ? data.first_task[cell + 1] : first;
  // Of many partials each warp adds up a part, in order, and the parts are added up in theirs.
  const int warps = last - first < kManyPartials ? 1 : kThreads / 32, wide = kThreads / warps;
  const int part = threadIdx.x / wide;
  const int64_t share = ceil_div(last - first, static_cast<int64_t>(warps)), begin = first + part * share;
  const int64_t end = begin + share < last ? begin + share : last;
  VN_SHARED(sums, float[kThreads]);
  // to(i, the sum at place(i)) for i up to count.
  const auto sum = [&](int count, const auto& place, const auto& to) {
    for (int from = blockIdx.z * wide; from < count; from += gridDim.z * wide) {
      const int i = from + threadIdx.x % wide;
      float total = 0.0f;
      if (i < count) {
        const int at = place(i);
        for (int64_t task = begin; task < end; ++task) total += data.partials[task * plan.partial + at];
      }
      if (warps > 1) {
        sums[threadIdx.x] = total;
        __syncthreads();
        for (int other = 1; part == 0 && other < warps; ++other) total += sums[other * wide + threadIdx.x];
        __syncthreads();  // the sums are read
      }
      if (part == 0 && i < count) to(i, total);
    }
  };
  float* weights = gradients.weights[blockIdx.y];
  float* biases = gradients.biases[blockIdx.y];
  for (int s = 0; s < layer.source_count; ++s) {
    const MlpCudaSource& source = layer.sources[s];
    const auto row = [&](int i) { return i / source.width; };
    sum(
        layer.width * source.width,
        [&](int i) { return layer.partial + row(i) * (layer.partial_stride - source.width) + source.packed + i; },
        [&](int i, float total) {
          weights[(cell * layer.width + row(i)) * layer.inputs + source.column + i - row(i) * source.width] = total;
        });
  }
  if (biases == nullptr) return;
  sum(
      layer.width, [&](int i) { return layer.partial_bias + i; },
      [&](int i, float total) { biases[cell * layer.width + i] = total; });
}

template <typename Products>
void pack(const MlpCudaPlan& plan, const MlpCudaData& data, const MlpCudaParameters& parameters,
          const MlpStrays& strays, void* stream) {
  int64_t pairs = 1;
  for (int l = 0; l < plan.layer_count; ++l) {
    pairs = std::max(pairs, int64_t{plan.layers[l].padded} * plan.layers[l].weight_stride / 2);
  }
  const dim3 grid(static_cast<unsigned>(data.k), plan.layer_count,
                  mlp_cuda_layer_blocks(data.k, plan.layer_count, pairs));
  VN_LAUNCH((mlp_pack_kernel<Products>), grid, kThreads, 0, stream, plan, data, parameters, strays);
}

}  // namespace

unsigned mlp_cuda_layer_blocks(int64_t k, int layers, int64_t elements) {
  const int64_t blocks = kBlocksPerMultiprocessor * mlp_cuda_device().multiprocessors;
  const int64_t wanted = ceil_div(blocks, std::max<int64_t>(1, k * layers));
  const int64_t useful = ceil_div(elements, int64_t{kThreads});
  return static_cast<unsigned>(wanted < useful ? wanted : useful);
}

const MlpCudaDevice& mlp_cuda_device() {
  thread_local int asked = -1;
  thread_local MlpCudaDevice found{};
  int device = 0;
  VN_CUDA_CHECK(cudaGetDevice(&device));
  if (asked == device) return found;
  int major = 0, minor = 0, cache = 0;
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&found.shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&found.multiprocessors, cudaDevAttrMultiProcessorCount, device));
  VN_CUDA_CHECK(cudaDeviceGetAttribute(&cache, cudaDevAttrL2CacheSize, device));
  // Code for a lower architecture than the device's chooses its instructions by that.
  cudaFuncAttributes compiled{};
  VN_CUDA_CHECK(cudaFuncGetAttributes(&compiled, mlp_tasks_kernel));
  found.capability = std::min(10 * major + minor, compiled.ptxVersion);
  found.cache_bytes = cache;
  asked = device;
  return found;
}

void mlp_cuda_number_tasks(const MlpCudaData& data, int64_t task_rows, int64_t tasks, void* stream) {
  VN_LAUNCH(mlp_tasks_kernel, 1, kScanThreads, 0, stream, data, task_rows, tasks);
}

void mlp_cuda_prepare(const MlpCudaPlan& plan, const MlpCudaData& data, const MlpCudaParameters& parameters,
                      const MlpStrays& strays, void* stream) {
  mlp_with_products(plan.precision,
                    [&](auto products) { pack<decltype(products)>(plan, data, parameters, strays, stream); });
}

void mlp_cuda_zero_strays(const MlpCudaData& data, int width, float* rows, void* stream) {
  if (data.n == 0 || rows == nullptr) return;
  const int64_t blocks = ceil_div<int64_t>(data.n, kThreads);
  VN_LAUNCH(mlp_strays_kernel, static_cast<unsigned>(blocks < 1024 ? blocks : 1024), kThreads, 0, stream, data, width,
            rows);
}

// Rows of no cell, and inputs that nothing reads, have no gradient.
void mlp_cuda_clear_gradient(const MlpCudaData& data, bool used, int width, float* gradient, void* stream) {
  if (gradient == nullptr || data.n == 0) return;
  if (used) return mlp_cuda_zero_strays(data, width, gradient, stream);
  VN_CUDA_CHECK(cudaMemsetAsync(gradient, 0, sizeof(float) * data.n * width, static_cast<cudaStream_t>(stream)));
}

void mlp_cuda_reduce(const MlpCudaPlan& plan, const MlpCudaData& data, const MlpCudaParameterGradients& gradients,
                     void* stream) {
  int64_t weights = 1;
  for (int l = 0; l < plan.layer_count; ++l) {
    for (int s = 0; s < plan.layers[l].source_count; ++s) {
      weights = std::max(weights, int64_t{plan.layers[l].width} * plan.layers[l].sources[s].width);
    }
  }
  VN_LAUNCH(mlp_reduce_kernel,
            dim3(static_cast<unsigned>(data.k), plan.layer_count,
                 mlp_cuda_layer_blocks(data.k, plan.layer_count, kThreads / 32 * weights)),
            kThreads, 0, stream, plan, data, gradients);
}

}  // namespace voronerf
