// Runs every CPU kernel except networks on random and edge sizes, with every instruction set of the machine. The tests
// in Python (tests/) compare numbers with the reference. Here every array has exactly the needed size, so that
// sanitizers guard its ends, and outputs start poisoned. Every eighth case has NaN and infinity among its inputs. One
// and three threads must agree bit for bit. All instruction sets must agree with the portable path.
#include <algorithm>
#include <cstdio>
#include <cstdlib>

#include "cases.h"
#include "common/parallel.h"
#include "encoding/adam.h"
#include "encoding/encode.h"
#include "geometry/cell_sort.h"
#include "geometry/locate_cell.h"
#include "geometry/nearest_centre.h"
#include "rays/composite.h"
#include "rays/march_rays.h"
#include "rays/render_loss.h"
#include "rays/resample.h"

namespace {

using voronerf::Isa;

template <typename T>
void search(Isa isa) {
  const int64_t counts[] = {1, 2, 16, 17, 255, 256, 257, 300 + below(300), 2048 + below(3000)};
  const int64_t n = some_rows(), k = counts[below(9)], d = 1 + below(4);
  const Array<T> points = below(2) == 0 ? uniform<T>(d * n) : lattice<T>(d * n);
  const bool was_wild = wild;
  wild = false;  // centres are finite
  const Array<T> centres = below(2) == 0 ? uniform<T>(d * k) : lattice<T>(d * k);
  wild = was_wild;
  const int axes = static_cast<int>(d);
  const int64_t words = voronerf::centre_index_words(k, axes, sizeof(T));
  Array<int32_t> found(n, -7), again(n, -7), index(words, -7), same_index(words, -7);
  voronerf::index_centres_cpu(centres.data(), index.data(), k, axes, 1);
  voronerf::index_centres_cpu(centres.data(), same_index.data(), k, axes, 3);
  same(index, same_index, "index_centres");
  voronerf::nearest_centre_cpu(points.data(), centres.data(), nullptr, found.data(), n, k, d, 0, isa, 1);
  voronerf::nearest_centre_cpu(points.data(), centres.data(), nullptr, again.data(), n, k, d, 0, isa, 3);
  same(found, again, "nearest_centre");
  voronerf::nearest_centre_cpu(points.data(), centres.data(), index.data(), again.data(), n, k, d, words, isa, 1);
  same(found, again, "nearest_centre by an index");
  within(found, k, "nearest_centre");
  like_portable(found, "nearest_centre");
}

template <typename T>
void locate(Isa isa) {
  // Subdivides every second centre of the root by diagrams of different sizes.
  const int64_t n = some_rows(), root = 1 + below(20);
  Array<int32_t> offsets = {0, static_cast<int32_t>(root)}, child(root);
  int32_t leaves = 0;
  for (int64_t i = 0; i < root; ++i) {
    if (i % 2 == 0) {
      child[i] = -1 - leaves++;
      continue;
    }
    child[i] = static_cast<int32_t>(offsets.size() - 1);
    const int32_t size = static_cast<int32_t>(1 + below(17));
    for (int32_t j = 0; j < size; ++j) child.push_back(-1 - leaves++);
    offsets.push_back(offsets.back() + size);
  }
  const int64_t m = offsets.back();
  const Array<T> points = uniform<T>(3 * n), centres = lattice<T>(3 * m);
  if (voronerf::locate_cell_fault(offsets.data(), child.data(), static_cast<int64_t>(offsets.size()) - 1, m)) {
    fail("locate_cell: a sound tree refused");
  }
  Array<int32_t> results[2];
  for (int i = 0; i < 2; ++i) {
    const int threads = 1 + 2 * i;
    results[i].assign(n, -7);
    Array<int32_t> workspace(voronerf::locate_cell_workspace(m, threads));
    if (!voronerf::locate_cell_cpu(points.data(), centres.data(), offsets.data(), child.data(), results[i].data(),
                                   workspace.data(), n, m, 2, isa, threads)) {
      fail("locate_cell: did not arrive");
    }
  }
  same(results[0], results[1], "locate_cell");
  within(results[0], leaves, "locate_cell");
  like_portable(results[0], "locate_cell");
}

void sort() {
  const int64_t counts[] = {1, 2, 255, 256, 5000, 100000};
  const int64_t n = below(3) == 0 ? 70000 + below(9) : some_rows(), k = counts[below(6)];
  Array<int32_t> cells(n);
  for (int32_t& cell : cells) cell = static_cast<int32_t>(below(2) == 0 ? k - 1 : below(k));
  const bool broken = n > 0 && below(4) == 0;
  if (broken) cells[below(n)] = below(2) == 0 ? -1 : static_cast<int32_t>(k);
  Array<int32_t> order[2], offsets[2];
  for (int i = 0; i < 2; ++i) {
    order[i].assign(n, -7);
    offsets[i].assign(k + 1, -7);
    const bool valid =
        voronerf::cell_sort_cpu(cells.data(), order[i].data(), offsets[i].data(), n, k, 1 + 2 * i);
    if (valid == broken) fail("cell_sort: cells out of range not told from those in range");
  }
  if (broken) return;
  same(order[0], order[1], "cell_sort");
  same(offsets[0], offsets[1], "cell_sort");
  for (int64_t i = 1; i < n; ++i) {
    const int32_t a = order[0][i - 1], b = order[0][i];
    if (cells[a] > cells[b] || (cells[a] == cells[b] && a >= b)) fail("cell_sort: not in order");
  }
}

void composite(Isa isa) {
  const int64_t r = below(100), s = below(40), c = 1 + below(5);
  const bool packed = below(2) == 0, background = below(2) == 0, per_ray = below(2) == 0;
  Array<int32_t> offsets;
  int64_t m = r * s;
  if (packed) {
    m = below(3);
    for (int64_t i = 0; i <= r; ++i) {
      offsets.push_back(static_cast<int32_t>(m));
      if (i < r) m += below(3) == 0 ? 0 : below(70);
    }
    m += below(3);  // adds samples of no ray
  }
  const Array<float> sigma = uniform<float>(m), rgb = uniform<float>(m * c), depths = uniform<float>(m);
  const Array<float> deltas = uniform<float>(m), behind = uniform<float>(background ? (per_ray ? r * c : c) : 0);
  const voronerf::CompositeInputs in{sigma.data(), rgb.data(), depths.data(), deltas.data(), or_null(offsets),
                                     background ? behind.data() : nullptr, per_ray, r, s, m, c};
  const Array<float> to_colour = uniform<float>(r * c), to_opacity = uniform<float>(r), to_depth = uniform<float>(r);
  const Array<float> to_weights = uniform<float>(m);
  const int64_t asked = below(16);
  Array<float> results[2][10];
  for (int i = 0; i < 2; ++i) {
    Array<float>* out = results[i];
    const int64_t sizes[] = {r * c, r, r, m, m, m * c, m, m, static_cast<int64_t>(behind.size()), r};
    for (int j = 0; j < 10; ++j) out[j] = poisoned(sizes[j]);
    voronerf::composite_cpu(in, {out[0].data(), out[1].data(), out[2].data(), out[3].data()}, isa, 1 + 2 * i);
    const voronerf::CompositeGradients gradients{asked & 1 ? to_colour.data() : nullptr,
                                                 asked & 2 ? to_opacity.data() : nullptr,
                                                 asked & 4 ? to_depth.data() : nullptr,
                                                 asked & 8 ? to_weights.data() : nullptr, out[4].data(), out[5].data(),
                                                 out[6].data(), asked & 1 ? out[7].data() : nullptr,
                                                 background ? out[8].data() : nullptr, out[9].data()};
    voronerf::composite_backward_cpu(in, gradients, isa, 1 + 2 * i);
  }
  for (int j = 0; j < 9; ++j) {
    same(results[0][j], results[1][j], "composite");
    if (wild || (j == 7 && (asked & 1) == 0)) continue;
    like_portable(results[0][j], "composite");
    for (const float value : results[0][j]) {
      if (!std::isfinite(value)) fail("composite: result " + std::to_string(j) + " is not finite");
    }
  }
}

void encode(Isa isa) {
  using voronerf::ProgramEncoding;
  const int kind = below(4);
  const bool integrated = kind == 0, harmonics = kind == 1, include = kind == 2;
  const int64_t counts[] = {below(3), 32 * below(9) + below(3), below(harmonics ? 3000 : 200)}, n = counts[below(3)];
  const int d = integrated || harmonics ? 3 : below(9), size = harmonics ? 1 + below(4) : below(12);
  const int width = harmonics ? size * size : d * (2 * size + (include ? 1 : 0));
  const Array<float> x = uniform<float>(n * d);
  Array<float> variances = uniform<float>(integrated ? n * d : 0);
  for (float& variance : variances) variance = std::fabs(variance);
  const Array<float> gradient = uniform<float>(n * width);
  const ProgramEncoding encoding = integrated  ? ProgramEncoding::integrated
                                   : harmonics ? ProgramEncoding::spherical
                                               : ProgramEncoding::frequency;
  const voronerf::Encoding in{encoding, n, width, x.data(), integrated ? variances.data() : nullptr, d, size, include};
  Array<float> results[2][3];
  for (int i = 0; i < 2; ++i) {
    const int threads = 1 + 2 * i;
    results[i][0] = poisoned(n * width);
    results[i][1] = poisoned(n * d);
    results[i][2] = poisoned(variances.size());
    voronerf::encode_cpu(in, results[i][0].data(), isa, threads);
    voronerf::encode_backward_cpu(in, gradient.data(), results[i][1].data(),
                                  integrated ? results[i][2].data() : nullptr, isa, threads);
  }
  for (int j = 0; j < 3; ++j) {
    same(results[0][j], results[1][j], "encode");
    like_portable(results[0][j], "encode");
    for (const float value : results[0][j]) {
      if (!wild && !std::isfinite(value)) {
        fail("encode: result " + std::to_string(j) + " of kind " + std::to_string(kind) +
             " is not finite for d = " + std::to_string(d) + ", size = " + std::to_string(size));
      }
    }
  }
}

void march(Isa isa) {
  const int64_t r = below(4) == 0 ? 300 : below(9), s = 1 + below(70), x = 1 + below(9), y = 1 + below(9),
                z = 1 + below(9);
  const Array<float> origins = uniform<float>(3 * r), directions = uniform<float>(3 * r);
  const Array<float> near(r, 0.1f), far(r, 3.0f), uniforms = uniform<float>(below(2) * r * s);
  const float box[] = {-1.0f, -1.0f, -1.0f, 1.0f, 1.0f, 1.0f}, sphere[] = {0.0f, 0.0f, 0.0f, 0.5f};
  const int32_t seed = static_cast<int32_t>(below(1000));
  Array<uint8_t> occupied(x * y * z);
  for (uint8_t& cell : occupied) cell = static_cast<uint8_t>(below(2));
  const bool hashed = uniforms.empty() && below(2) == 0, contracted = below(2) == 0;
  const auto spacing = static_cast<voronerf::MarchSpacing>(below(2));
  const voronerf::MarchInputs in{origins.data(), directions.data(), near.data(), far.data(), occupied.data(), box,
                                 or_null(uniforms), hashed ? &seed : nullptr, nullptr, r, s, x, y, z, spacing,
                                 1 + below(s), {contracted ? sphere : nullptr, nullptr}};
  Array<float> depths[2];
  for (int i = 0; i < 2; ++i) {
    const int threads = 1 + 2 * i;
    Array<uint32_t> mask(r * voronerf::march_words(s));
    Array<int32_t> offsets(r + 1, -7);
    int64_t rows = -7;
    voronerf::march_rays_count_cpu(in, mask.data(), offsets.data(), &rows, r * s, isa, threads);
    if (rows != offsets[r]) fail("march_rays: the total is not the last offset");
    Array<int32_t> ray(rows), stop(r);
    Array<float> deltas = poisoned(rows), positions = poisoned(3 * rows);
    depths[i] = poisoned(rows);
    voronerf::march_rays_fill_cpu(in, mask.data(), offsets.data(), rows, ray.data(), depths[i].data(), deltas.data(),
                                  positions.data(), stop.data(), isa, threads);
    within(ray, std::max<int64_t>(r, 1), "march_rays");
    if (i > 0) continue;
    // Rounding may move a sample on a border into the next cell.
    const double found = static_cast<double>(rows);
    like_portable(Array<double>{found}, "march_rays", 1e-2);
  }
  same(depths[0], depths[1], "march_rays");
}

void loss(Isa isa) {
  const int64_t r = below(100);
  Array<int32_t> offsets{0};
  for (int64_t i = 0; i < r; ++i) {
    offsets.push_back(offsets.back() + static_cast<int32_t>(below(3) == 0 ? 0 : below(70)));
  }
  const int64_t m = offsets.back();
  const bool per_ray = below(2) == 0;
  const bool activated = below(2) == 0;
  Array<float> raw = uniform<float>(4 * m);
  for (int64_t i = 0; activated && i < m; ++i) raw[4 * i + 3] = std::fabs(raw[4 * i + 3]);
  const Array<float> target = uniform<float>(3 * r);
  const Array<float> background = uniform<float>(below(2) * (per_ray ? 3 * r : 3));
  Array<float> deltas = uniform<float>(m);
  for (float& delta : deltas) delta = std::fabs(delta);
  const float robust = below(2) == 0 ? 0.0f : 0.05f;
  const int64_t triples = below(2) * below(1 + r / 3);
  const voronerf::RenderLossInputs in{raw.data(), deltas.data(), offsets.data(), target.data(), or_null(background),
                                      per_ray,    10.0f,         activated,      1e-4f,         robust,
                                      triples,    r,             m};
  const int64_t sizes[] = {1, 3 * r, m, m, r, 4 * m};
  Array<float> results[2][6];
  for (int i = 0; i < 2; ++i) {
    for (int j = 0; j < 6; ++j) results[i][j] = poisoned(sizes[j]);
    Array<float>* out = results[i];
    voronerf::render_loss_cpu(
        in, {out[0].data(), out[1].data(), out[2].data(), out[3].data(), out[4].data(), out[5].data()}, isa, 1 + 2 * i);
  }
  for (int j = 0; j < 6; ++j) {
    same(results[0][j], results[1][j], "render_loss");
    if (r > 0) like_portable(results[0][j], "render_loss", 1e-4);
  }
}

void adam(Isa isa) {
  const int64_t n = some_rows();
  const bool every = below(2) == 0;
  Array<float> gradient = uniform<float>(n);
  for (float& value : gradient) {
    if (below(4) > 0) value = 0.0f;
  }
  const Array<float> start[] = {uniform<float>(n), uniform<float>(n), uniform<float>(n)};
  for (int i = 0; i < 2; ++i) {
    Array<float> parameter = start[0], mean = start[1], square = start[2];
    for (float& value : square) value = std::fabs(value);
    float step = 2.0f;
    const std::vector<voronerf::AdamRule> rules = {{1e-2, nullptr, &step, 0.9, 0.99, 1e-8, every}};
    const float* gradients[] = {gradient.data()};
    float *parameters[] = {parameter.data()}, *means[] = {mean.data()}, *squares[] = {square.data()};
    voronerf::adam_cpu(rules, parameters, gradients, means, squares, {}, {n}, isa, 1 + 2 * i);
    like_portable(parameter, "adam");
    like_portable(mean, "adam");
  }
}

void resample() {
  const int64_t r = below(4) == 0 ? 300 : below(9), s = 1 + below(70), count = 1 + below(70);
  const Array<float> weights = uniform<float>(r * s), uniforms = uniform<float>(below(2) * r * count);
  Array<float> edges = uniform<float>(r * (s + 1));
  Array<float> depths[2];
  for (int i = 0; i < 2; ++i) {
    depths[i] = poisoned(r * count);
    voronerf::resample_cpu(weights.data(), edges.data(), or_null(uniforms), depths[i].data(), r, s, count, 1 + 2 * i);
  }
  same(depths[0], depths[1], "resample");
  for (const float depth : depths[0]) {
    if (!wild && !std::isfinite(depth)) fail("resample: a depth is not finite");
  }
}

}  // namespace

int main(int count, char** arguments) {
  const int cases = count > 1 ? std::atoi(arguments[1]) : 60;
  for (int i = 0; i < cases; ++i) {
    wild = i % 8 == 7;
    for (const Isa isa : {Isa::portable, Isa::neon, Isa::avx2, Isa::avx512, Isa::avx512_bf16}) {
      if (!voronerf::isa_supported(isa)) continue;
      start_case(i, isa == Isa::portable);
      const auto ops = [&] {
        search<float>(isa);
        if (i % 4 == 0) search<double>(isa);
        locate<float>(isa);
        if (i % 4 == 0) locate<double>(isa);
        composite(isa);
        encode(isa);
        march(isa);
        loss(isa);
        adam(isa);
      };
      i % 2 == 0 ? ops() : voronerf::with_team(3, ops);  // odd cases run with a team, as replays do
    }
    sort();
    resample();
  }
  std::printf("%d cases\n", cases);
  return 0;
}
