// render_loss on the CPU: threads share blocks of rays. Rays are independent, and one thread sums their errors, so
// results do not depend on the number of threads.
#include "rays/render_loss.h"

#include <algorithm>

#include "common/parallel.h"
#include "rays/ray_offsets.h"
#include "rays/render_loss_isa.h"
#include "rays/render_loss_math.h"

namespace voronerf {

namespace {

void rays_of(Isa isa, const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, render_loss_rays(in, out, begin, end))
}

void strays_of(Isa isa, const RenderLossInputs& in, const RenderLossOutputs& out, int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, render_loss_strays(in, out, begin, end))
}

}  // namespace

void render_loss_cpu(const RenderLossInputs& in, const RenderLossOutputs& out, Isa isa, int threads) {
  check_ray_offsets("render_loss", in.offsets, in.r, in.m);
  strays_of(isa, in, out, 0, in.offsets[0]);
  strays_of(isa, in, out, in.offsets[in.r], in.m);
  parallel_blocks(in.r, kRenderLossRays, threads, [&](int64_t begin, int64_t end) {
    const int64_t middle = std::clamp(in.r - 3 * in.triples, begin, end);
    rays_of(isa, in, out, begin, middle);
    rays_of(isa, in, out, middle, end);
  });
  double sum = 0.0;
  for (int64_t i = 0; i < in.r; ++i) sum += static_cast<double>(ray_loss(out.error[i], in.robust));
  *out.loss = static_cast<float>(sum / (3.0 * static_cast<double>(in.r)));
}

}  // namespace voronerf
