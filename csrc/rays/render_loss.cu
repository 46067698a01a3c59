// The loss of rendered rays and its gradient on CUDA: one warp per ray, 32 samples at a time, as in composite.cu. The
// formulas are in render_loss_isa.cpp. One launch walks along a ray until its colour is known, and then back. The last
// chunk of samples stays in registers in between; with an occupancy grid this is mostly the whole ray. For earlier
// chunks the raw outputs are read again, and the optical depth is stored in the memory of the density's gradient. A
// sample takes 20 bytes of reads and 24 bytes of writes.
#include "common/cuda_wrappers.h"
#include "rays/ray_warp.h"
#include "rays/render_loss.h"
#include "rays/render_loss_math.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;
constexpr int kWarps = kThreads / 32;

__device__ float sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }

__device__ float density_of(float x, float scale) { return ((x < 0.0f ? 0.0f : x) + log1pf(expf(-fabsf(x)))) * scale; }

__device__ float4 load_row(const float* raw, int64_t i, bool aligned) {
  const float* row = raw + 4 * i;
  return aligned ? *reinterpret_cast<const float4*>(row) : make_float4(row[0], row[1], row[2], row[3]);
}

__device__ void store_row(float* gradient, int64_t i, float4 row) {
  *reinterpret_cast<float4*>(gradient + 4 * i) = row;
}

// A sample after activation. A lane without a sample has delta 0 and a black colour.
struct Sample {
  float rgb[3] = {};
  float density = 0.0f, slope = 0.0f, delta = 0.0f, optical = 0.0f;  // slope: derivative of density by raw
};

template <bool Activated>
__device__ Sample sample_of(const RenderLossInputs& in, int64_t i, bool active, bool aligned) {
  Sample sample;
  if (!active) return sample;
  const float4 raw = load_row(in.raw, i, aligned);
  if (Activated) {
    sample.rgb[0] = raw.x, sample.rgb[1] = raw.y, sample.rgb[2] = raw.z;
    sample.density = raw.w;
    sample.slope = sample.density > kOpaque ? 0.0f : 1.0f;
  } else {
    sample.rgb[0] = sigmoid(raw.x), sample.rgb[1] = sigmoid(raw.y), sample.rgb[2] = sigmoid(raw.z);
    sample.density = density_of(raw.w, in.density_scale);
    sample.slope = sample.density > kOpaque ? 0.0f : sigmoid(raw.w) * in.density_scale;
  }
  sample.delta = in.deltas[i];
  sample.optical = finite_density(sample.density) * sample.delta;
  return sample;
}

template <bool Activated>
__global__ void __launch_bounds__(kThreads) render_loss_kernel(RenderLossInputs in, RenderLossOutputs out) {
  const int lane = threadIdx.x % 32;
  const int64_t ray = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (ray >= in.r) return;  // the same for the whole warp
  const RayRange range = ray_range(in.offsets, ray, in.m);
  const bool aligned = reinterpret_cast<uintptr_t>(in.raw) % 16 == 0;
  Sample sample;
  float light[3] = {}, front = 0.0f;
  Carry carry;
  for (int64_t start = range.begin; start < range.end; start += 32) {
    const int64_t i = start + lane;
    const bool active = i < range.end;
    sample = sample_of<Activated>(in, i, active, aligned);
    front = depth_in_front(sample.optical, lane, carry);
    const float weight = expf(-front) * -expm1f(-sample.optical);
    for (int k = 0; k < 3; ++k) light[k] = fmaf(weight, sample.rgb[k], light[k]);
    if (!active) continue;
    out.weights[i] = weight;
    out.density[i] = sample.density;
    if (start + 32 < range.end) out.gradient[4 * i + 3] = front;  // read again below, by the same thread
  }
  const float* background = in.background;
  if (background != nullptr && in.background_per_ray) background += 3 * ray;
  const float left = expf(-carry.plus(0.0f)), share = 2.0f / (3.0f * static_cast<float>(in.r));
  float slopes[3], error = 0.0f;
  for (int k = 0; k < 3; ++k) {
    const float shown = background == nullptr ? 0.0f : background[k];
    const float colour = fmaf(left, shown, sum_of_lanes(light[k]));
    if (lane == 0) out.colour[3 * ray + k] = colour;
    slopes[k] = colour - in.target[3 * ray + k];
    error += slopes[k] * slopes[k];
  }
  const bool has_target = ray < in.r - 3 * in.triples;
  if (lane == 0) out.error[ray] = has_target ? error : 0.0f;
  if (!has_target) {  // the same for the whole warp
    for (int64_t i = range.begin + lane; i < range.end; i += 32) store_row(out.gradient, i, {});
    return;
  }
  const float scale = share * ray_loss_slope(error, in.robust);
  Carry behind;
  for (int k = 0; k < 3; ++k) {
    slopes[k] *= scale;
    behind.add(slopes[k] * (background == nullptr ? 0.0f : background[k]) * left);
  }
  const int64_t chunks = ceil_div<int64_t>(range.end - range.begin, 32);
  for (int64_t chunk = chunks; chunk-- > 0;) {
    const int64_t i = range.begin + 32 * chunk + lane;
    const bool active = i < range.end;
    if (chunk + 1 < chunks) {  // an earlier chunk, which is full
      sample = sample_of<Activated>(in, i, true, aligned);
      front = out.gradient[4 * i + 3];
    }
    const float arriving = expf(-front), weight = arriving * -expm1f(-sample.optical);
    float of_weight = 0.0f, of_raw[3];
    for (int k = 0; k < 3; ++k) {
      of_weight = fmaf(slopes[k], sample.rgb[k], of_weight);
      of_raw[k] = weight * slopes[k];
      if (!Activated) of_raw[k] *= sample.rgb[k] * (1.0f - sample.rgb[k]);
    }
    const float shares_behind = share_behind(active ? of_weight * weight : 0.0f, lane, behind);
    const float of_optical = of_weight * (arriving * expf(-sample.optical)) - shares_behind;
    if (!active) continue;
    float4 row = make_float4(of_raw[0], of_raw[1], of_raw[2], of_optical * sample.delta * sample.slope);
    if (arriving <= in.hidden) row = {};
    store_row(out.gradient, i, row);
  }
}

// Handles samples without a ray, [0, offsets[0]) and [offsets[r], m): computes their density, and zeros their weights
// and gradient.
__global__ void __launch_bounds__(kThreads) render_loss_strays(RenderLossInputs in, RenderLossOutputs out) {
  const int64_t first = in.offsets[0], last = in.offsets[in.r], step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < in.m; i += step) {
    if (i >= first && i < last) continue;
    out.weights[i] = 0.0f;
    out.density[i] = in.activated ? in.raw[4 * i + 3] : density_of(in.raw[4 * i + 3], in.density_scale);
    for (int k = 0; k < 4; ++k) out.gradient[4 * i + k] = 0.0f;
  }
}

// Computes the mean loss of the rays in one block, summed in an order that does not depend on the device.
__global__ void __launch_bounds__(kThreads)
    render_loss_mean(const float* __restrict__ error, float robust, int64_t r, float* loss) {
  VN_SHARED(sums, double[kThreads]);
  double sum = 0.0;
  for (int64_t ray = threadIdx.x; ray < r; ray += kThreads) sum += static_cast<double>(ray_loss(error[ray], robust));
  sum = sum_of_block<kThreads>(sum, sums);
  if (threadIdx.x == 0) *loss = static_cast<float>(sum / (3.0 * static_cast<double>(r)));
}

}  // namespace

void render_loss_cuda(const RenderLossInputs& in, const RenderLossOutputs& out, void* stream) {
  if (in.m > 0) {
    const int64_t blocks = ceil_div<int64_t>(in.m, kThreads);
    VN_LAUNCH(render_loss_strays, static_cast<unsigned>(blocks < 1024 ? blocks : 1024), kThreads, 0, stream, in, out);
  }
  if (in.r > 0) {
    const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(in.r, kWarps));
    if (in.activated) {
      VN_LAUNCH(render_loss_kernel<true>, blocks, kThreads, 0, stream, in, out);
    } else {
      VN_LAUNCH(render_loss_kernel<false>, blocks, kThreads, 0, stream, in, out);
    }
  }
  VN_LAUNCH(render_loss_mean, 1, kThreads, 0, stream, out.error, in.robust, in.r, out.loss);
}

}  // namespace voronerf
