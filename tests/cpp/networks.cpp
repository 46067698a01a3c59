// Every path of grouped_mlp over random layer tables and cells, with every instruction set of the machine.
//
// Numbers are compared with the reference in Python (tests/native/test_native_mlp.py); here every array has exactly its
// size, outputs start poisoned and must come out finite, one and three threads must agree bit for bit, and all
// instruction sets with the portable path.
#include <algorithm>
#include <memory>

#include "cases.h"
#include "network/grouped_mlp.h"
#include "network/grouped_mlp_layout.h"

namespace {

using voronerf::Activation;
using voronerf::encoded_width;
using voronerf::MlpEncodingKind;
using voronerf::MlpTable;

// Up to five levels, the first of which have an entry for each corner.
voronerf::HashGrid random_grid() {
  voronerf::HashGrid grid{{}, {-1.0f, -1.0f, -1.0f}, {0.5f, 1.0f, 2.0f}, int64_t{1} << below(4), below(2) == 0};
  const int64_t levels = 1 + below(5);
  int64_t offset = 0;
  for (int64_t l = 0; l < levels; ++l) {
    const int32_t side = static_cast<int32_t>(3 + below(3) + 3 * l);
    const bool hashes = side * side * side > 1024;
    const int64_t entries = hashes ? 1024 : (side * side * side + 7) / 8 * 8;
    grid.levels.push_back({static_cast<float>(side - 1), 0.5f, side, entries, offset, hashes});
    offset += entries;
  }
  return grid;
}

MlpTable random_table() {
  const int64_t widths[] = {1, 3, 4, 5, 15, 16, 17, 33, 48, 63, 64, 65, 90};
  MlpTable table;
  table.positions = 1 + below(20);
  table.directions = 1 + below(4);
  table.position = {static_cast<MlpEncodingKind>(below(4)), static_cast<int>(1 + below(4))};
  table.direction = {below(2) == 0 ? MlpEncodingKind::none : MlpEncodingKind::frequency, static_cast<int>(below(3))};
  table.half = below(2) == 0;
  if (table.position.kind == MlpEncodingKind::integrated) table.positions = 6;
  if (table.position.kind == MlpEncodingKind::hash) {
    table.grid = random_grid();
    table.positions = 3;
    table.position.size = static_cast<int>(static_cast<int64_t>(table.grid.levels.size()) * table.grid.features);
  }
  if (below(3) == 0) {
    table.directions = 3;
    table.direction = {MlpEncodingKind::spherical, static_cast<int>(1 + below(4))};
  }
  const int64_t layers = 1 + below(5);
  for (int64_t l = 0; l < layers; ++l) {
    voronerf::MlpLayer layer;
    layer.width = widths[below(13)];
    layer.activation = static_cast<Activation>(below(5));
    const int64_t sources = 1 + below(10) / 3 + (below(20) == 0 ? 9 : 0);
    for (int64_t s = 0; s < sources; ++s) layer.inputs.push_back(static_cast<int>(below(l + 2)) - 2);
    table.layers.push_back(layer);
  }
  const int64_t outputs = 1 + below(3);
  for (int64_t o = 0; o < outputs; ++o) table.outputs.push_back(static_cast<int>(below(layers)));
  if (below(2) == 0) {  // a head of few outputs, which are dot products
    table.layers.push_back({32 * (1 + below(3)), Activation::relu, {voronerf::kFromPositions}});
    table.layers.push_back({1 + below(4), static_cast<Activation>(below(5)), {static_cast<int>(layers)}});
    table.outputs.push_back(static_cast<int>(layers) + 1);
  }
  return table;
}

struct Result {
  Array<float> out, positions, directions, features;
  std::vector<Array<float>> weights, biases;

  bool finite() const {
    for (const Array<float>* array : all()) {
      for (const float value : *array) {
        if (!std::isfinite(value)) return false;
      }
    }
    return true;
  }

  bool operator==(const Result& other) const {
    const auto mine = all(), theirs = other.all();
    for (size_t i = 0; i < mine.size(); ++i) {
      if (mine[i]->size() != theirs[i]->size()) return false;
      if (!mine[i]->empty() && std::memcmp(mine[i]->data(), theirs[i]->data(), mine[i]->size() * sizeof(float)) != 0) {
        return false;
      }
    }
    return true;
  }

  std::vector<const Array<float>*> all() const {
    std::vector<const Array<float>*> arrays = {&out, &positions, &directions, &features};
    for (const Array<float>& array : weights) arrays.push_back(&array);
    for (const Array<float>& array : biases) arrays.push_back(&array);
    return arrays;
  }
};

struct Case {
  MlpTable table = random_table();
  std::vector<int32_t> offsets, index, order;
  Array<float> positions, directions, gradient, features;
  std::vector<Array<float>> weights, biases;
  int64_t n, rays, k, width = 0, tables = 1;
  bool bias = below(3) > 0;

  Case() {
    k = 1 + below(6);
    n = below(4);
    for (int64_t c = 0; c <= k; ++c) {
      offsets.push_back(static_cast<int32_t>(n));
      const int64_t sizes[] = {0, 1, below(60), below(500), 1300};
      if (c < k) n += sizes[below(5)];
    }
    n += below(4);  // rows of no cell
    const bool indexed = below(2) == 0 && n > 0;
    rays = indexed ? 1 + below(20) : n;
    for (int64_t i = 0; indexed && i < n; ++i) index.push_back(static_cast<int32_t>(below(rays)));
    const bool ordered = below(2) == 0;
    for (int64_t i = 0; ordered && i < n; ++i) order.push_back(static_cast<int32_t>(i));
    std::shuffle(order.begin(), order.end(), generator);
    positions = uniform<float>(n * table.positions);
    if (table.position.kind == MlpEncodingKind::integrated) {  // the second half are variances
      for (int64_t i = 0; i < n * 6; ++i) positions[i] = i % 6 < 3 ? positions[i] : std::fabs(positions[i]);
    }
    directions = uniform<float>(rays * table.directions);
    tables = below(2) == 0 ? 1 : k;
    for (const voronerf::GridLevel& level : table.grid.levels) {
      const Array<float> more = uniform<float>(tables * level.entries * table.grid.features);
      features.insert(features.end(), more.begin(), more.end());
    }
    features.shrink_to_fit();
    for (const voronerf::MlpLayer& layer : table.layers) {
      int64_t depth = 0;
      for (const int from : layer.inputs) {
        depth += from >= 0                          ? table.layers[from].width
                 : from == voronerf::kFromPositions ? encoded_width(table.positions, table.position)
                                                    : encoded_width(table.directions, table.direction);
      }
      weights.push_back(uniform<float>(k * layer.width * depth));
      for (float& weight : weights.back()) weight /= static_cast<float>(depth);
      biases.push_back(uniform<float>(bias ? k * layer.width : 0));
    }
    for (const int output : table.outputs) width += table.layers[output].width;
    gradient = uniform<float>(n * width);
  }

  Result run(voronerf::Isa isa, int threads, bool parameters, bool inputs) const {
    std::vector<const float*> w, b;
    std::vector<float*> grad_w, grad_b;
    Result result;
    for (size_t l = 0; l < weights.size(); ++l) {
      w.push_back(weights[l].data());
      b.push_back(bias ? biases[l].data() : nullptr);
      result.weights.push_back(poisoned(parameters ? weights[l].size() : 0));
      result.biases.push_back(poisoned(parameters ? biases[l].size() : 0));
      grad_w.push_back(result.weights[l].data());
      grad_b.push_back(bias ? result.biases[l].data() : nullptr);
    }
    result.out = poisoned(n * width);
    result.positions = poisoned(inputs ? positions.size() : 0);
    result.directions = poisoned(inputs ? directions.size() : 0);
    result.features = poisoned(inputs ? features.size() : 0);
    Array<float> hashed = poisoned(table.grid.levels.empty() ? 0 : n * ((table.position.size + 15) / 16 * 16));
    const voronerf::MlpInputs in{positions.data(), directions.data(), index.empty() ? nullptr : index.data(),
                                 offsets.data(), w.data(), b.data(), n, rays, k, order.empty() ? nullptr : order.data(),
                                 features.data(), voronerf::TableType::float32, tables, hashed.data()};
    voronerf::grouped_mlp_cpu(table, in, result.out.data(), isa, threads);
    const voronerf::MlpGradients gradients{gradient.data(), parameters ? grad_w.data() : nullptr, grad_b.data(),
                                           inputs ? result.positions.data() : nullptr,
                                           inputs ? result.directions.data() : nullptr,
                                           inputs && !features.empty() ? result.features.data() : nullptr};
    voronerf::grouped_mlp_backward_cpu(table, in, gradients, isa, threads);
    return result;
  }
};

}  // namespace

int main(int count, char** arguments) {
  using voronerf::Isa;
  const int cases = count > 1 ? std::atoi(arguments[1]) : 60;
  for (int i = 0; i < cases; ++i) {
    const Case one;
    for (const Isa isa : {Isa::portable, Isa::neon, Isa::avx2, Isa::avx512, Isa::avx512_bf16}) {
      if (!voronerf::isa_supported(isa)) continue;
      const Result alone = one.run(isa, 1, true, true), together = one.run(isa, 3, true, true);
      if (!alone.finite()) fail("case " + std::to_string(i) + ": an output was not written");
      if (!(alone == together)) fail("case " + std::to_string(i) + ": threads disagree");
      start_case(i + 1, isa == Isa::portable);
      for (const Array<float>* result : alone.all()) {
        like_portable(*result, "grouped_mlp", isa == Isa::avx512_bf16 && one.table.half ? 0.1 : 1e-3);
      }
      one.run(isa, 2, i % 2 == 0, i % 2 == 1);
    }
  }
  std::printf("%d cases\n", cases);
  return 0;
}
