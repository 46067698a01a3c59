// The CPU kernel of render_opaque, compiled once per instruction set. It computes the samples' weights as in
// render_loss, and adds the samples to their rays.
#include "rays/render_opaque_isa.h"

#include "rays/render_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

void see_wave(const SeenWave& in, int64_t r) {
  Chunk chunk;
  each_chunk(in, 0, r, [&](int64_t from, int64_t to) {
    const int64_t end = in.offsets[to];
    for (int64_t first = in.offsets[from]; first < end; first += kChunk) {
      const int64_t count = end - first < kChunk ? end - first : kChunk;
      activate(in, first, count, chunk);
      pass(in, from, to, first, count, in.front + from, chunk);
      weigh(count, chunk);
      each_ray(in, from, to, first, count, [&](int64_t ray, int64_t begin, int64_t stop) {
        const int64_t number = in.number[from + ray];
        float colour[3] = {}, opacity = 0.0f, depth = 0.0f;
        for (int64_t i = begin; i < stop; ++i) {
          const float weight = chunk.weights[i];
          for (int k = 0; k < 3; ++k) colour[k] += weight * chunk.rgb[k][i];
          opacity += weight;
          depth += weight * in.depths[first + i];
        }
        for (int k = 0; k < 3; ++k) in.colour[3 * number + k] += colour[k];
        in.opacity[number] += opacity;
        in.depth[number] += depth;
        for (int64_t i = begin; in.most != nullptr && i < stop; ++i) {
          if (!(chunk.weights[i] > in.most[from + ray])) continue;
          in.most[from + ray] = chunk.weights[i];
          in.heaviest[number] = in.depths[first + i];
        }
      });
    }
  });
  for (int64_t ray = 0; ray < r; ray += kLanes) {
    float lanes[kLanes] = {};
    const int64_t count = r - ray < kLanes ? r - ray : kLanes;
    for (int64_t i = 0; i < count; ++i) lanes[i] = static_cast<float>(in.front[ray + i]);
    store(lanes, transmittance(load(lanes)));
    for (int64_t i = 0; i < count; ++i) in.light[in.number[ray + i]] = lanes[i];
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
