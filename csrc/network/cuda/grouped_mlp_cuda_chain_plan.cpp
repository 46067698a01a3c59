#include <algorithm>
#include <vector>

#include "common/common.h"
#include "encoding/encode_math.h"
#include "network/cuda/grouped_mlp_cuda_chain.h"
#include "network/grouped_mlp_layout.h"

namespace voronerf {

namespace {

// Tasks of a multiprocessor: many, since the last ones leave others idle.
constexpr int kTasks = 32;
// Warps that a multiprocessor should have, so that one works while another waits.
constexpr int kEnough = 8;
constexpr int kBlockReserve = 1024;  // bytes of shared memory that a block costs besides its own

int steps_of(int width) { return ceil_div(width, kChainStep); }

// Warps of which the registers fit a multiprocessor; what __launch_bounds__ of the kernels says.
int warps_of(int width) { return width == 32 ? 16 : width == 64 ? 12 : 8; }

MlpChainInput input_of(const MlpCudaInput& given) {
  MlpChainInput input{};
  input.raw = given.raw;
  input.octaves = given.octaves;
  input.integrated = given.integrated;
  input.used = given.used;
  input.features = std::max(1, given.integrated ? given.raw / 2 : given.raw);
  input.units = given.octaves > 0 ? input.features * ceil_div(given.octaves, 2) : 0;
  input.last = octave_scale(given.octaves - 1);
  input.steps = ceil_div(input.units + (given.integrated ? 0 : ceil_div(given.raw, 4)), 4);
  return input;
}

// Layers that outputs depend on, with their sources as numbers of layers of the plan, from `kFrom...` on otherwise.
using Reads = std::vector<std::vector<int>>;
Reads copy_layers(const MlpCudaPlan& table, MlpChainPlan& plan) {
  Reads reads;
  std::vector<int> number(table.layer_count, -1);
  for (int l = 0; l < table.layer_count; ++l) {
    const MlpCudaLayer& given = table.layers[l];
    if (!given.live) continue;
    number[l] = plan.layer_count;
    MlpChainLayer& layer = plan.layers[plan.layer_count++];
    layer.index = l;
    layer.width = given.width;
    layer.inputs = given.inputs;
    layer.activation = given.activation;
    layer.region = -1;
    layer.source_count = given.source_count;
    reads.emplace_back();
    for (int s = 0; s < given.source_count; ++s) {
      const MlpCudaSource& source = given.sources[s];
      const int steps = source.from == kFromPositions    ? plan.positions.steps
                        : source.from == kFromDirections ? plan.directions.steps
                                                         : steps_of(source.width);
      layer.sources[s] = {MlpChainFrom::stored, steps, -1, false, source.column, source.width};
      layer.steps += steps;
      reads.back().push_back(source.from >= 0 ? number[source.from] : source.from);
      if (source.from >= 0) plan.layers[number[source.from]].read = true;
      if (source.from < 0) layer.fresh = true;
    }
    layer.piece = static_cast<int>(plan.packed_bytes);
    for (int chunk = 0; chunk < chain_chunks(layer.width); ++chunk, ++plan.pieces) {
      const int bytes = chain_piece_bytes(layer.steps, chain_pairs(chain_tiles(layer.width, chunk, layer.fresh)));
      plan.slot = std::max(plan.slot, bytes);
      plan.packed_bytes += bytes;
    }
  }
  plan.output_count = table.output_count;
  plan.out_features = table.out_features;
  for (int o = 0; o < table.output_count; ++o) {
    plan.outputs[o] = number[table.outputs[o]];
    plan.output_columns[o] = table.output_columns[o];
    plan.layers[plan.outputs[o]].among = true;
  }
  return reads;
}

// The first layer after `layer` that reads `value`; the number of layers if none does.
int next_read(const Reads& reads, int value, int layer) {
  for (int l = layer + 1; l < static_cast<int>(reads.size()); ++l) {
    if (std::find(reads[l].begin(), reads[l].end(), value) != reads[l].end()) return l;
  }
  return static_cast<int>(reads.size());
}

// Who finds what in registers: of the value that is held and a new one, that which is read first stays.
void hold(const Reads& reads, MlpChainPlan& plan) {
  int held = -1;
  for (int l = 0; l < plan.layer_count; ++l) {
    MlpChainLayer& layer = plan.layers[l];
    for (int s = 0; s < layer.source_count; ++s) {
      const int from = reads[l][s];
      MlpChainSource& source = layer.sources[s];
      source.from = from == kFromPositions    ? MlpChainFrom::positions
                    : from == kFromDirections ? MlpChainFrom::directions
                    : from == held            ? MlpChainFrom::held
                                              : MlpChainFrom::stored;
    }
    if (!layer.read) continue;
    layer.held = held < 0 || next_read(reads, l, l) <= next_read(reads, held, l);
    if (layer.held) held = l;
  }
}

// Places in a warp's region of values that are read when they are not held, of values of two chunks, of which the first
// waits there, and of encodings that are read again if `keep` says so. A layer may read a source while it writes.
void place(const Reads& reads, bool keep, MlpChainPlan& plan) {
  const int end = plan.layer_count;
  std::vector<int> last(plan.layer_count, -1);
  for (int l = 0; l < end; ++l) {
    for (int s = 0; s < plan.layers[l].source_count; ++s) {
      if (plan.layers[l].sources[s].from == MlpChainFrom::stored) last[reads[l][s]] = l;
    }
  }
  Arena arena;
  const auto take = [&](int steps, int start, int until) {
    return static_cast<int>(arena.take(int64_t{steps} * 2 * kChainQuad, start, until));
  };
  const auto place_input = [&](int from, const MlpChainInput& input) {
    int count = 0, first = end, until = -1;
    for (int l = 0; l < end; ++l) {
      const int here = static_cast<int>(std::count(reads[l].begin(), reads[l].end(), from));
      if (here == 0) continue;
      count += here * chain_chunks(plan.layers[l].width);
      first = std::min(first, l);
      until = l;
    }
    const int region = keep && count > 1 ? take(input.steps, first, until) : -1;
    bool there = false;
    for (int l = 0; l < end; ++l) {
      for (int s = 0; s < plan.layers[l].source_count; ++s) {
        if (reads[l][s] != from) continue;
        plan.layers[l].sources[s].region = region;
        plan.layers[l].sources[s].compute = region < 0 || !there;
        there = true;
      }
    }
  };
  place_input(kFromPositions, plan.positions);
  place_input(kFromDirections, plan.directions);
  for (int l = 0; l < end; ++l) {
    MlpChainLayer& layer = plan.layers[l];
    int steps = 0;  // as many as are packed
    for (int chunk = 0; chunk < chain_chunks(layer.width); ++chunk) {
      steps += chain_pairs(chain_tiles(layer.width, chunk, layer.fresh));
    }
    const bool waits = layer.held && layer.width > kChainChunk;
    layer.region = last[l] < 0 && !waits ? -1 : take(steps, l, std::max(l, last[l]));
  }
  for (int l = 0; l < end; ++l) {
    for (int s = 0; s < plan.layers[l].source_count; ++s) {
      MlpChainSource& source = plan.layers[l].sources[s];
      if (source.from == MlpChainFrom::stored) source.region = plan.layers[reads[l][s]].region;
    }
  }
  plan.region = static_cast<int>(arena.total());
}

// The size of a block that gives a multiprocessor most warps, of several the smallest, or of blocks that wait for
// pieces the largest, which shares them; the number of those warps, 0: no block fits.
int shape(const MlpCudaDevice& device, MlpChainPlan& plan) {
  const int most = warps_of(plan.width);
  const int64_t weights = plan.resident ? plan.packed_bytes : 2 * int64_t{plan.slot};
  int best = 0;
  for (const int warps : {4, 8, 12, 16, 2, 1}) {
    if (warps > most || (warps < 4 && best > 0)) continue;
    const int64_t bytes = weights + int64_t{warps} * plan.region;
    if (bytes > device.shared_bytes) continue;
    const int64_t blocks =
        std::min<int64_t>(most / warps, (int64_t{device.shared_bytes} + kBlockReserve) / (bytes + kBlockReserve));
    const int there = warps * static_cast<int>(blocks);
    if (there < best || (there == best && plan.resident)) continue;
    best = there;
    plan.warps = warps;
    plan.weights = static_cast<int>(weights);
    plan.shared_bytes = static_cast<int>(bytes);
  }
  return best;
}

}  // namespace

const char* mlp_chain_plan(const MlpTable& table, MlpPrecision precision, int64_t n, int64_t k,
                           const MlpCudaDevice& device, MlpChainPlan& plan) {
  plan = {};
  const bool half =
      precision == MlpPrecision::float16 || (precision == MlpPrecision::bfloat16 && device.capability >= 80);
  if (!half) return "products must be of 16 bits, on tensor cores that have them";
  plan.precision = precision;
  MlpCudaPlan read{};
  if (const char* fault = mlp_cuda_read_table(table, read)) return fault;
  if (read.positions.hashed) return "hash grids must be looked up by tiles";
  // Its registers are full: sixteen harmonics would not stay in them on every device.
  if (read.positions.degree > 0 || read.directions.degree > 0) {
    return "spherical harmonics must be computed by tiles or layers";
  }
  plan.positions = input_of(read.positions);
  plan.directions = input_of(read.directions);
  const Reads reads = copy_layers(read, plan);
  int widest = 0;
  for (int l = 0; l < plan.layer_count; ++l) widest = std::max(widest, plan.layers[l].width);
  if (widest > kChainWidest) return "a layer must have at most 128 features";
  plan.width = widest > 64 ? 128 : widest > 32 ? 64 : 32;
  hold(reads, plan);
  // Resident weights spare barriers; an encoding that is kept is cheaper than one that is computed again, but takes
  // memory. The first that leaves enough warps, else the one with most.
  struct Shape {
    bool resident, keep;
  };
  constexpr Shape kShapes[] = {{true, true}, {true, false}, {false, true}, {false, false}};
  const auto attempt = [&](const Shape& each) {
    plan.resident = each.resident;
    place(reads, each.keep, plan);
    return shape(device, plan);
  };
  const Shape* chosen = nullptr;
  int most = 0;
  for (const Shape& each : kShapes) {
    const int warps = attempt(each);
    if (warps <= most) continue;
    most = warps;
    chosen = &each;
    if (warps >= kEnough) break;
  }
  if (chosen == nullptr) return "two pieces of weights must fit the shared memory of a block";
  attempt(*chosen);
  const int64_t wanted = std::max<int64_t>(1, int64_t{kTasks} * device.multiprocessors);
  plan.task_rows = ceil_div(std::max<int64_t>(1, ceil_div(n, wanted)), int64_t{plan.rows()}) * plan.rows();
  plan.tasks = n / plan.task_rows + k;  // every cell's last task may be short
  return nullptr;
}

MlpCudaWorkspace mlp_chain_workspace(const MlpChainPlan& plan, int64_t k) {
  const auto aligned = [](int64_t bytes) { return ceil_div<int64_t>(bytes, 256) * 256; };
  MlpCudaWorkspace parts{};
  parts.first_task = aligned(plan.packed_bytes * k);
  parts.partials = parts.bytes = parts.first_task + aligned(4 * (k + 1));
  return parts;
}

}  // namespace voronerf
