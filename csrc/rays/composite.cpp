// composite on the CPU: threads share the rays. One thread sums a ray in the order of its samples, and one thread sums
// the gradient of a shared background, so results do not depend on the number of threads.
#include "rays/composite.h"

#include <algorithm>

#include "common/parallel.h"
#include "rays/composite_isa.h"
#include "rays/ray_offsets.h"

namespace voronerf {

namespace {

constexpr int kRays = 32;  // rays of a task

void check(const CompositeInputs& in) {
  if (in.offsets != nullptr) check_ray_offsets("composite", in.offsets, in.r, in.m);
}

int64_t first_sample(const CompositeInputs& in, int64_t ray) {
  return in.offsets == nullptr ? ray * in.s : in.offsets[ray];
}

template <typename Run>
void for_each_ray(const CompositeInputs& in, int threads, const Run& run) {
  parallel_for(in.r, kRays, threads, [&](int64_t ray) { run(ray, first_sample(in, ray), first_sample(in, ray + 1)); });
}

// Zeros the values of samples without a ray.
void zero_strays(const CompositeInputs& in, int64_t width, float* values) {
  if (in.offsets == nullptr || values == nullptr) return;
  std::fill(values, values + in.offsets[0] * width, 0.0f);
  std::fill(values + in.offsets[in.r] * width, values + in.m * width, 0.0f);
}

// Computes the gradient of the background, whose weight is a ray's transmittance.
void background_backward(const CompositeInputs& in, const CompositeGradients& gradients) {
  if (gradients.background == nullptr) return;
  if (gradients.colour == nullptr) {
    std::fill_n(gradients.background, in.background_per_ray ? in.r * in.c : in.c, 0.0f);
  } else if (in.background_per_ray) {
    for (int64_t i = 0; i < in.r * in.c; ++i) {
      gradients.background[i] = gradients.left[i / in.c] * gradients.colour[i];
    }
  } else {
    for (int64_t k = 0; k < in.c; ++k) {
      double sum = 0.0;
      for (int64_t ray = 0; ray < in.r; ++ray) {
        sum += static_cast<double>(gradients.left[ray]) * gradients.colour[ray * in.c + k];
      }
      gradients.background[k] = static_cast<float>(sum);
    }
  }
}

}  // namespace

void composite_cpu(const CompositeInputs& in, const CompositeOutputs& out, Isa isa, int threads) {
  check(in);
  zero_strays(in, 1, out.weights);
  for_each_ray(in, threads, [&](int64_t ray, int64_t begin, int64_t end) {
    VN_FOR_ISA(isa, composite_ray(in, out, ray, begin, end))
  });
}

void composite_backward_cpu(const CompositeInputs& in, const CompositeGradients& gradients, Isa isa, int threads) {
  check(in);
  float* const of_samples[] = {gradients.sigma, gradients.depths, gradients.deltas};
  for (float* values : of_samples) zero_strays(in, 1, values);
  zero_strays(in, in.c, gradients.rgb);
  for_each_ray(in, threads, [&](int64_t ray, int64_t begin, int64_t end) {
    VN_FOR_ISA(isa, composite_ray_backward(in, gradients, ray, begin, end))
  });
  background_backward(in, gradients);
}

}  // namespace voronerf
