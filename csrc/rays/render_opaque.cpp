// render_opaque on the CPU. Each thread has a pool of active rays and processes a wave of their samples at a time: it
// marches through the grid, sorts samples by cell, evaluates the networks and adds to the colours. The image's next ray
// replaces a ray that has ended, so that waves stay large. A ray's result depends neither on the other rays in the pool
// nor on the number of threads.
#include "rays/render_opaque.h"

#include <algorithm>
#include <atomic>
#include <memory>
#include <vector>

#include "common/common.h"
#include "common/flush_denormals.h"
#include "common/parallel.h"
#include "geometry/cell_sort.h"
#include "geometry/locate_cell.h"
#include "geometry/nearest_centre.h"
#include "network/cpu/program_rows.h"
#include "network/cpu/row_tasks.h"
#include "rays/march_rays_isa.h"
#include "rays/march_rooms.h"
#include "rays/render_opaque_isa.h"

namespace voronerf {

namespace {

// The approximate number of samples in a wave. A quarter of it would fit in the L2 cache but is slower, because the
// weights of a cell are packed for each wave and the last tile of its rows is half empty.
constexpr int64_t kSamples = 32768;
constexpr int64_t kShare = 8;  // minimum number of pools per thread in an image, for load balance
constexpr int64_t kRun = 32;   // rays of the image that a thread takes at once

void count_strata(Isa isa, const MarchInputs& in, const uint8_t* room, uint32_t* mask, int32_t* counts) {
  VN_FOR_ISA(isa, march_count(in, room, mask, counts, 0, in.r))
}
void fill_samples(Isa isa, const MarchInputs& in, const uint32_t* mask, const int32_t* offsets, int32_t* ray_index,
                  float* depths, float* deltas, float* positions, int32_t* stop) {
  VN_FOR_ISA(isa, march_fill(in, mask, offsets, ray_index, depths, deltas, positions, stop, 0, in.r))
}
void add_wave(Isa isa, const SeenWave& in, int64_t r) { VN_FOR_ISA(isa, see_wave(in, r)) }

// The arguments of one call, which its threads read.
struct RenderCall {
  const ProgramInputs& network;
  const ProgramRows& rows;
  const MarchInputs& march;
  const uint8_t* room;
  const SeeCells& cells;
  const SeeOptions& options;
  const SeeOutputs& out;
  int64_t directions;  // q, the columns of the directions
  Isa isa;
  int threads;
};

class Pool {
 public:
  Pool(const RenderCall& call, float* workspace)
      : call_(call),
        network_(call.network),
        own_{workspace},
        size_(std::clamp<int64_t>(std::min(kSamples / call.options.wave, call.march.r / (kShare * call.threads)), 64,
                                  8192)),
        number_(size_),
        start_(size_),
        stop_(size_),
        near_(size_),
        far_(size_),
        most_(size_),
        origins_(3 * size_),
        along_(3 * size_),
        directions_(call.directions * size_),
        front_(size_),
        mask_(size_ * march_words(call.march.s)),
        offsets_(size_ + 1),
        samples_(size_ * call.options.wave),
        descent_(call.cells.child == nullptr ? 0 : locate_cell_workspace(call.cells.m, 1)),
        cell_offsets_(call.network.k + 1) {}

  // Renders rays until `items` has none left. Returns false if the descent of a sample's position ends without a leaf.
  bool run(Items& items, int thread) {
    while (refill(items, thread) > 0) {
      if (!wave()) return false;
      drop();
    }
    return true;
  }

 private:
  struct Samples {
    explicit Samples(int64_t count)
        : ray(count), cell(count), order(count), depths(count), deltas(count), positions(3 * count), raw(4 * count) {}
    std::vector<int32_t> ray, cell, order;
    std::vector<float> depths, deltas, positions, raw;
  };

  int64_t refill(Items& items, int thread) {
    for (; count_ < size_; ++count_) {
      if (next_ == end_ && !items.take(thread, next_, end_)) {
        next_ = end_ = 0;
        break;
      }
      const int64_t ray = next_++;
      number_[count_] = static_cast<int32_t>(ray);
      start_[count_] = 0;
      near_[count_] = call_.march.near[ray];
      far_[count_] = call_.march.far[ray];
      most_[count_] = 0.0f;
      front_[count_] = 0.0;
      std::copy_n(call_.march.origins + 3 * ray, 3, &origins_[3 * count_]);
      std::copy_n(call_.march.directions + 3 * ray, 3, &along_[3 * count_]);
      const int64_t q = call_.directions;
      const auto* directions = q > 0 ? static_cast<const float*>(call_.network.inputs[1]) : nullptr;
      if (q > 0) std::copy_n(directions + q * ray, q, &directions_[q * count_]);
      std::fill_n(call_.out.colour + 3 * ray, 3, 0.0f);
      call_.out.opacity[ray] = call_.out.depth[ray] = 0.0f;
      call_.out.light[ray] = 1.0f;
      if (call_.out.heaviest != nullptr) call_.out.heaviest[ray] = far_[count_];
    }
    return count_;
  }

  bool wave() {
    MarchInputs march = call_.march;
    march.origins = origins_.data(), march.directions = along_.data();
    march.near = near_.data(), march.far = far_.data();
    march.start = start_.data();
    march.r = count_;
    march.max_samples = call_.options.wave;
    count_strata(call_.isa, march, call_.room, mask_.data(), offsets_.data() + 1);
    offsets_[0] = 0;
    for (int64_t i = 0; i < count_; ++i) offsets_[i + 1] += offsets_[i];
    Samples& all = samples_;
    fill_samples(call_.isa, march, mask_.data(), offsets_.data(), all.ray.data(), all.depths.data(), all.deltas.data(),
                 all.positions.data(), stop_.data());
    ProgramInputs& in = network_;
    in.n = offsets_[count_];
    in.r = count_;
    const void* inputs[] = {all.positions.data(), directions_.data()};
    in.inputs = inputs;
    in.order = nullptr;
    in.ray_index = call_.directions > 0 ? all.ray.data() : nullptr;
    if (!sort(in)) return false;
    void* outputs[] = {all.raw.data()};
    results_.outputs = outputs;
    call_.rows.forward(in, results_, own_);
    const SeeOutputs& out = call_.out;
    add_wave(
        call_.isa,
        {all.raw.data(), all.depths.data(), all.deltas.data(), offsets_.data(), number_.data(), front_.data(),
         out.heaviest == nullptr ? nullptr : most_.data(), out.colour, out.opacity, out.depth, out.light, out.heaviest},
        count_);
    return true;
  }

  // Sorts the samples by cell. Returns false if the descent of a sample's position ends without a leaf.
  bool sort(ProgramInputs& in) {
    const SeeCells& cells = call_.cells;
    in.offsets = cell_offsets_.data();
    const auto* positions = static_cast<const float*>(in.inputs[0]);
    if (cells.centres == nullptr) {
      cell_offsets_[0] = 0, cell_offsets_[1] = static_cast<int32_t>(in.n);
      return true;
    }
    int32_t *cell = samples_.cell.data(), *order = samples_.order.data();
    if (cells.centre_index != nullptr) {
      search_index_serial(positions, cells.centre_index, cell, in.n, centre_index_shape(cells.m, 3, sizeof(float)), 3,
                          call_.isa);
    } else if (cells.child == nullptr) {
      nearest_centre_serial(positions, cells.centres, cell, in.n, cells.m, call_.isa);
    } else if (!locate_cell_cpu(positions, cells.centres, cells.child_offsets, cells.child, cell, descent_.data(), in.n,
                                cells.m, cells.depth, call_.isa, 1)) {
      return false;
    }
    in.order = order;
    return cell_sort_cpu(cell, order, cell_offsets_.data(), in.n, in.k, 1);
  }

  // Finishes the rays that have ended, and keeps the others.
  void drop() {
    int64_t kept = 0;
    for (int64_t i = 0; i < count_; ++i) {
      if (stop_[i] >= call_.march.s || !(call_.out.light[number_[i]] > call_.options.opaque)) {
        finish(number_[i], far_[i]);
        continue;
      }
      const int64_t q = call_.directions;
      number_[kept] = number_[i], start_[kept] = stop_[i], near_[kept] = near_[i], far_[kept] = far_[i];
      most_[kept] = most_[i], front_[kept] = front_[i];
      std::copy_n(&origins_[3 * i], 3, &origins_[3 * kept]);
      std::copy_n(&along_[3 * i], 3, &along_[3 * kept]);
      if (q > 0) std::copy_n(&directions_[q * i], q, &directions_[q * kept]);
      ++kept;
    }
    count_ = kept;
  }

  // Turns the sums of a ray into its outputs. The colour of an opaque ray is divided by its opacity.
  void finish(int64_t ray, float far) const {
    const SeeOutputs& out = call_.out;
    const SeeOptions& options = call_.options;
    float *const colour = out.colour + 3 * ray, &opacity = out.opacity[ray];
    out.depth[ray] = opacity > 0.0f ? out.depth[ray] / opacity : far;
    if (out.light[ray] <= options.opaque) {
      for (int i = 0; i < 3; ++i) colour[i] /= opacity;
      opacity = 1.0f;
    }
    if (options.background == nullptr) return;
    const float* const background = options.background + (options.background_per_ray ? 3 * ray : 0);
    for (int i = 0; i < 3; ++i) colour[i] += (1.0f - opacity) * background[i];
  }

  const RenderCall& call_;
  ProgramInputs network_;
  ProgramResults results_{nullptr, {TableType::float32}, nullptr};
  ProgramRows::WorkerMemory own_;
  const int64_t size_;
  int64_t count_ = 0, next_ = 0, end_ = 0;
  std::vector<int32_t> number_, start_, stop_;
  std::vector<float> near_, far_, most_, origins_, along_, directions_;
  std::vector<double> front_;
  std::vector<uint32_t> mask_;
  std::vector<int32_t> offsets_;
  Samples samples_;
  std::vector<int32_t> descent_, cell_offsets_;
};

}  // namespace

bool render_opaque_cpu(const Program& program, const ProgramInputs& network, const MarchInputs& march,
                       const SeeCells& cells, const SeeOptions& options, const SeeOutputs& out, Isa isa, int threads) {
  if (march.r == 0) return true;
  const std::unique_ptr<uint8_t[]> rooms = march_rooms(march, threads);
  const ProgramRows rows(program, network, isa);
  const std::vector<ProgramInput>& inputs = program.table.inputs;
  const Workspace workspace(rows.workspace() * std::max(threads, 1));
  const RenderCall call{network, rows,
                        march,   rooms.get(),
                        cells,   options,
                        out,     inputs.size() > 1 ? inputs[1].width : 0,
                        isa,     std::max(threads, 1)};
  const int team = static_cast<int>(std::min<int64_t>(threads, ceil_div<int64_t>(march.r, kRun)));
  Items items(march.r, kRun, team);
  std::vector<std::unique_ptr<Pool>> pools;  // allocated here, because code on the team's threads must not throw
  for (int thread = 0; thread < team; ++thread) {
    pools.push_back(std::make_unique<Pool>(call, workspace.data() + thread * rows.workspace()));
  }
  std::atomic<bool> sound{true};
  parallel(team, [&](int thread) {
    const FlushDenormals flush;  // for the networks
    if (!pools[static_cast<size_t>(thread)]->run(items, thread)) sound = false;
  });
  return sound;
}

}  // namespace voronerf
