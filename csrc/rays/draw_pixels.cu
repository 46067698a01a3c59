// Draws the pixels of a training step on CUDA, one thread per pixel.
#include "common/cuda_wrappers.h"
#include "rays/draw_pixels.h"

namespace voronerf {

namespace {

constexpr int kThreads = 128;

__global__ void __launch_bounds__(kThreads)
    draw_pixels_kernel(DrawPixelsInputs in, int64_t* __restrict__ pixels, float* __restrict__ uniforms,
                       float* __restrict__ distances) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.b) return;
  const uint32_t key = hash_key(*in.seed, i);
  const int64_t place = draw_place(key, i < in.known_count ? in.p : in.below);
  for (int channel = 0; channel < 3; ++channel) uniforms[3 * i + channel] = hashed(key, 2 + channel);
  if (i < in.known_count) {
    pixels[i] = in.known_pixels[place];
    distances[i] = in.distances[place];
    return;
  }
  pixels[i] = in.ends == nullptr ? place : place + in.shift[run_of(in, first_run(in, place), place)];
}

}  // namespace

void draw_pixels_cuda(const DrawPixelsInputs& in, int64_t* pixels, float* uniforms, float* distances, void* stream) {
  if (in.b == 0) return;
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(in.b, kThreads));
  VN_LAUNCH(draw_pixels_kernel, blocks, kThreads, 0, stream, in, pixels, uniforms, distances);
}

}  // namespace voronerf
