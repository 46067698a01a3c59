// Volume rendering on CUDA: one warp per ray, 32 samples at a time. Optical depths are scanned across the lanes. The
// sum of earlier chunks is carried in two floats, so that long rays stay precise without float64, which is slow on most
// GPUs. The formulas are in composite_isa.cpp. As there, the backward pass first walks along the ray and stores the
// optical depth in front of each sample in the memory of sigma's gradient, then walks back and sums over the samples
// behind.
#include "common/cuda_wrappers.h"
#include "rays/composite.h"
#include "rays/ray_warp.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;
constexpr int kWarps = kThreads / 32;
constexpr int kChannels = 4;  // channels summed in one walk along the ray

__device__ RayRange samples_of(const CompositeInputs& in, int64_t ray) {
  if (in.offsets == nullptr) return {ray * in.s, (ray + 1) * in.s};
  return ray_range(in.offsets, ray, in.m);
}

__device__ const float* background_of(const CompositeInputs& in, int64_t ray) {
  return in.background == nullptr || !in.background_per_ray ? in.background : in.background + ray * in.c;
}

__global__ void __launch_bounds__(kThreads) composite_kernel(CompositeInputs in, CompositeOutputs out) {
  const int lane = threadIdx.x % 32;
  const int64_t ray = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (ray >= in.r) return;  // the same for the whole warp
  const RayRange range = samples_of(in, ray);
  const float* background = background_of(in, ray);
  float opacity = 0.0f, depth = 0.0f, left = 0.0f;
  int64_t channel = 0;
  do {  // four channels per walk; later walks read the weights back
    const int channels = static_cast<int>(in.c - channel < kChannels ? in.c - channel : kChannels);
    float colour[kChannels] = {};
    Carry carry;
    for (int64_t start = range.begin; start < range.end; start += 32) {
      const int64_t i = start + lane;
      const bool active = i < range.end;
      float weight = 0.0f;
      if (channel == 0) {
        const float optical = active ? finite_density(in.sigma[i]) * in.deltas[i] : 0.0f;
        const float front = depth_in_front(optical, lane, carry);
        weight = expf(-front) * -expm1f(-optical);
        if (active) {
          out.weights[i] = weight;
          opacity += weight;
          depth = fmaf(weight, in.depths[i], depth);
        }
      } else if (active) {
        weight = out.weights[i];  // written by the same thread
      }
      for (int k = 0; k < kChannels; ++k) {
        if (active && k < channels) colour[k] = fmaf(weight, in.rgb[i * in.c + channel + k], colour[k]);
      }
    }
    if (channel == 0) left = expf(-carry.plus(0.0f));
    for (int k = 0; k < kChannels; ++k) {
      const float sum = sum_of_lanes(colour[k]);
      if (lane == 0 && k < channels) {
        out.colour[ray * in.c + channel + k] = background == nullptr ? sum : fmaf(left, background[channel + k], sum);
      }
    }
    channel += kChannels;
  } while (channel < in.c);
  opacity = sum_of_lanes(opacity);
  depth = sum_of_lanes(depth);
  if (lane == 0) {
    out.opacity[ray] = opacity;
    out.depth[ray] = depth;
  }
}

__global__ void __launch_bounds__(kThreads) composite_backward_kernel(CompositeInputs in, CompositeGradients g) {
  const int lane = threadIdx.x % 32;
  const int64_t ray = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (ray >= in.r) return;  // the same for the whole warp
  const RayRange range = samples_of(in, ray);
  const float* colour = g.colour == nullptr ? nullptr : g.colour + ray * in.c;
  const float of_depth = g.depth == nullptr ? 0.0f : g.depth[ray];
  const float of_opacity = g.opacity == nullptr ? 0.0f : g.opacity[ray];

  Carry carry;
  for (int64_t start = range.begin; start < range.end; start += 32) {
    const int64_t i = start + lane;
    const bool active = i < range.end;
    const float optical = active ? finite_density(in.sigma[i]) * in.deltas[i] : 0.0f;
    const float front = depth_in_front(optical, lane, carry);
    if (active) g.sigma[i] = front;  // read again below, by the same thread
  }
  Carry behind;
  const float* background = background_of(in, ray);
  if (background != nullptr) {
    const float left = expf(-carry.plus(0.0f));
    if (lane == 0) g.left[ray] = left;
    for (int64_t k = 0; colour != nullptr && k < in.c; ++k) behind.add(colour[k] * background[k] * left);
  }
  const int64_t chunks = ceil_div<int64_t>(range.end - range.begin, 32);
  for (int64_t chunk = chunks; chunk-- > 0;) {
    const int64_t i = range.begin + 32 * chunk + lane;
    const bool active = i < range.end;
    const float sigma = active ? in.sigma[i] : 0.0f, delta = active ? in.deltas[i] : 0.0f;
    const float density = finite_density(sigma), optical = density * delta;
    const float light = active ? expf(-g.sigma[i]) : 0.0f;
    const float weight = light * -expm1f(-optical);
    float of_weight = of_opacity;
    if (active) {
      if (g.weights != nullptr) of_weight += g.weights[i];
      of_weight = fmaf(of_depth, in.depths[i], of_weight);
      for (int64_t k = 0; colour != nullptr && k < in.c; ++k)
        of_weight = fmaf(colour[k], in.rgb[i * in.c + k], of_weight);
    }
    const float share = active ? of_weight * weight : 0.0f;
    const float of_optical = of_weight * (light * expf(-optical)) - share_behind(share, lane, behind);
    if (!active) continue;
    g.sigma[i] = sigma <= kOpaque ? of_optical * delta : 0.0f;
    if (g.deltas != nullptr) g.deltas[i] = of_optical * density;
    if (g.depths != nullptr) g.depths[i] = of_depth * weight;
    for (int64_t k = 0; g.rgb != nullptr && k < in.c; ++k) {
      g.rgb[i * in.c + k] = colour == nullptr ? 0.0f : weight * colour[k];
    }
  }
}

// Zeros the values of samples without a ray: [0, offsets[0]) and [offsets[r], m).
__global__ void __launch_bounds__(kThreads)
    composite_strays(const int32_t* __restrict__ offsets, int64_t r, int64_t m, int64_t width, float* values) {
  const int64_t first = offsets[0], last = offsets[r];
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads;
  for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < m; i += step) {
    if (i >= first && i < last) continue;
    for (int64_t k = 0; k < width; ++k) values[i * width + k] = 0.0f;
  }
}

// Computes the gradient of a background that all rays share, whose weight is a ray's transmittance. One block per
// channel sums in an order that does not depend on the device.
__global__ void __launch_bounds__(kThreads)
    composite_shared_background(const float* __restrict__ left, const float* __restrict__ colour,
                                float* __restrict__ background, int64_t r, int64_t c) {
  VN_SHARED(sums, double[kThreads]);
  const int64_t k = blockIdx.x;
  double sum = 0.0;
  for (int64_t ray = threadIdx.x; colour != nullptr && ray < r; ray += kThreads) {
    sum += static_cast<double>(left[ray]) * static_cast<double>(colour[ray * c + k]);
  }
  sum = sum_of_block<kThreads>(sum, sums);
  if (threadIdx.x == 0) background[k] = static_cast<float>(sum);
}

__global__ void __launch_bounds__(kThreads)
    composite_own_background(const float* __restrict__ left, const float* __restrict__ colour,
                             float* __restrict__ background, int64_t r, int64_t c) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < r * c) background[i] = colour == nullptr ? 0.0f : left[i / c] * colour[i];
}

void zero_strays(const CompositeInputs& in, int64_t width, float* values, void* stream) {
  if (in.offsets == nullptr || values == nullptr || in.m * width == 0) return;
  const int64_t blocks = ceil_div<int64_t>(in.m, kThreads);
  VN_LAUNCH(composite_strays, static_cast<unsigned>(blocks < 1024 ? blocks : 1024), kThreads, 0, stream, in.offsets,
            in.r, in.m, width, values);
}

unsigned blocks_of_rays(int64_t r) { return static_cast<unsigned>(ceil_div<int64_t>(r, kWarps)); }

}  // namespace

void composite_cuda(const CompositeInputs& in, const CompositeOutputs& out, void* stream) {
  zero_strays(in, 1, out.weights, stream);
  if (in.r > 0) VN_LAUNCH(composite_kernel, blocks_of_rays(in.r), kThreads, 0, stream, in, out);
}

void composite_backward_cuda(const CompositeInputs& in, const CompositeGradients& gradients, void* stream) {
  float* const of_samples[] = {gradients.sigma, gradients.depths, gradients.deltas};
  for (float* values : of_samples) zero_strays(in, 1, values, stream);
  zero_strays(in, in.c, gradients.rgb, stream);
  if (in.r > 0) VN_LAUNCH(composite_backward_kernel, blocks_of_rays(in.r), kThreads, 0, stream, in, gradients);
  if (gradients.background == nullptr || in.c == 0) return;
  if (!in.background_per_ray) {
    VN_LAUNCH(composite_shared_background, static_cast<unsigned>(in.c), kThreads, 0, stream, gradients.left,
              gradients.colour, gradients.background, in.r, in.c);
  } else if (in.r > 0) {
    VN_LAUNCH(composite_own_background, static_cast<unsigned>(ceil_div<int64_t>(in.r * in.c, kThreads)), kThreads, 0,
              stream, gradients.left, gradients.colour, gradients.background, in.r, in.c);
  }
}

}  // namespace voronerf
