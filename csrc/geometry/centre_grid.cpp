// The centre grid on the CPU: building it, and its queries in blocks of points over threads.
//
// Building halves boxes along all axes at once. Three times for all of space together, level by level; the 512 boxes
// are then tasks, each with tables of its own, which are put one after the other at the end: neither the order of the
// tasks nor the number of threads shows in the result. A child whose parent's list has lost nobody shares its place,
// and a task that has reached its share of memory goes on with the lists of the parents, which are longer and as right.
#include "geometry/centre_grid.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "common/common.h"
#include "common/parallel.h"
#include "geometry/centre_grid_math.h"
#include "geometry/nearest_centre.h"

namespace voronerf {

namespace {

constexpr int64_t kBlock = 2048;
constexpr int kTop = 3;  // halvings until boxes are tasks
constexpr int kTasks = 1 << 3 * kTop;
// Lists longer than this are divided further, those up to the second are not worth striking more out of.
constexpr int32_t kLong = 8;
constexpr int32_t kShort = 1;
// A task above its share of memory divides no more cells; above this many shares it strikes nobody out either.
constexpr int64_t kHard = 2;

// Candidates of a box; `place` is where a task has stored them, -1 if it has not.
struct List {
  const int32_t* candidates;
  int32_t count;
  int32_t place;
};

struct Scene {
  const double* centres;  // [k,3]
  double middle[3], inverse[3];
  int bits;
  Isa isa;

  // Lowest and highest corner of cell x, y, z of 2^depth along an axis, widened.
  void box(int depth, const int32_t* cell, double* corners) const {
    const double size = 1.0 / static_cast<double>(1 << depth);
    for (int a = 0; a < 3; ++a) {
      corners[a] = grid_coordinate(std::max(0.0, cell[a] * size - kWiden), middle[a], inverse[a]);
      corners[3 + a] = grid_coordinate(std::min(1.0, (cell[a] + 1) * size + kWiden), middle[a], inverse[a]);
    }
  }

  void prune(int depth, const int32_t* cell, const List& list, std::vector<int32_t>& out,
             std::vector<double>& workspace) const {
    double corners[6];
    box(depth, cell, corners);
    out.resize(list.count);
    workspace.resize(std::max<size_t>(workspace.size(), kPruneWorkspace * list.count));
    out.resize(run(corners, list, out.data(), workspace.data()));
  }

  int32_t run(const double* corners, const List& list, int32_t* out, double* workspace) const {
    VN_FOR_ISA(isa, centre_grid_prune(corners, centres, list.candidates, list.count, out, workspace))
  }
};

// What one task makes: its part of the root grid, z fastest, and then its bricks.
class Task {
 public:
  std::vector<int32_t> entries, lists;

  // At most `share` int32 of tables and `effort` looks at a candidate, both a little more.
  Task(const Scene& scene, int64_t share, int64_t effort) : scene_(scene), share_(share), effort_(effort) {}

  void build(const int32_t* cell, const List& list) {
    const int bits = scene_.bits - kTop;
    entries.assign(int64_t{1} << 3 * bits, 0);
    List own = list;
    fill(0, bits, kTop, kTop, cell, own);
    // In the order of their size, so that memory goes to the large cells first.
    for (size_t i = 0; i < waiting_.size() && effort_ > 0 && !above(share_); ++i) divide(Cell(waiting_[i]));
  }

 private:
  // A cell whose list is long, and its entry.
  struct Cell {
    int64_t entry;
    int depth;
    int32_t at[3];
  };

  const Scene& scene_;
  const int64_t share_;
  int64_t effort_;
  std::vector<Cell> waiting_;
  std::vector<int32_t> kept_[kCellBits + 1];
  std::vector<double> workspace_;

  // Fills the part of the table at `table` (2^bits cells along an axis, its own box at `start` halvings) that the cell
  // covers.
  void fill(int64_t table, int bits, int start, int depth, const int32_t* cell, List& list) {
    const int rest = start + bits - depth;
    if (rest == 0) {
      const int64_t entry = slot(table, bits, cell);
      entries[entry] = store(list);
      if (list.count > kLong && depth + kBrickBits <= kCellBits) {
        waiting_.push_back({entry, depth, {cell[0], cell[1], cell[2]}});
      }
    } else if (list.count <= kShort) {
      const int32_t place = store(list), side = 1 << rest;
      for (int32_t x = 0; x < side; ++x) {
        for (int32_t y = 0; y < side; ++y) {
          for (int32_t z = 0; z < side; ++z) {
            const int32_t inner[3] = {(cell[0] << rest) + x, (cell[1] << rest) + y, (cell[2] << rest) + z};
            entries[slot(table, bits, inner)] = place;
          }
        }
      }
    } else {
      halve(table, bits, start, depth, cell, list);
    }
  }

  // Puts a brick in a cell's place, unless its lists are hardly shorter.
  void divide(const Cell& cell) {
    constexpr int64_t cells = 1 << 3 * kBrickBits;
    const int64_t brick = static_cast<int64_t>(entries.size());
    const size_t before = lists.size(), queue = waiting_.size();
    const int32_t place = entries[cell.entry];
    // A copy, since the lists move as they grow.
    const std::vector<int32_t> candidates(lists.begin() + place + 1, lists.begin() + place + 1 + lists[place]);
    List list{candidates.data(), lists[place], place};
    entries.resize(brick + cells);
    halve(brick, kBrickBits, cell.depth, cell.depth, cell.at, list);
    int64_t sum = 0;
    for (int64_t i = brick; i < brick + cells; ++i) sum += lists[entries[i]];
    if (4 * sum <= 3 * cells * list.count) {
      entries[cell.entry] = ~static_cast<int32_t>(brick);
      return;
    }
    entries.resize(brick);
    lists.resize(before);
    waiting_.resize(queue);
  }

  void halve(int64_t table, int bits, int start, int depth, const int32_t* cell, List& list) {
    for (int32_t octant = 0; octant < 8; ++octant) {
      const int32_t child[3] = {2 * cell[0] + (octant >> 2), 2 * cell[1] + (octant >> 1 & 1),
                                2 * cell[2] + (octant & 1)};
      std::vector<int32_t>& kept = kept_[depth + 1];
      const bool strike = effort_ > 0 && !above(kHard * share_);
      if (strike) {
        effort_ -= list.count;
        scene_.prune(depth + 1, child, list, kept, workspace_);
      }
      if (!strike || static_cast<int32_t>(kept.size()) == list.count) {
        fill(table, bits, start, depth + 1, child, list);
      } else {
        List shorter{kept.data(), static_cast<int32_t>(kept.size()), -1};
        fill(table, bits, start, depth + 1, child, shorter);
      }
    }
  }

  int64_t slot(int64_t table, int bits, const int32_t* cell) const {
    const int64_t low = (int64_t{1} << bits) - 1;
    return table + ((((cell[0] & low) << bits) + (cell[1] & low)) << bits) + (cell[2] & low);
  }

  bool above(int64_t size) const { return static_cast<int64_t>(entries.size() + lists.size()) > size; }

  int32_t store(List& list) {
    if (list.place < 0) {
      list.place = static_cast<int32_t>(lists.size());
      lists.push_back(list.count);
      lists.insert(lists.end(), list.candidates, list.candidates + list.count);
    }
    return list.place;
  }
};

// Indices of the first centre at each place, rising.
std::vector<int32_t> distinct(const double* centres, int32_t k) {
  std::vector<int32_t> order(k), kept;
  std::iota(order.begin(), order.end(), 0);
  const auto key = [&](int32_t i) { return centres + 3 * static_cast<int64_t>(i); };
  std::sort(order.begin(), order.end(), [&](int32_t a, int32_t b) {
    for (int d = 0; d < 3; ++d) {
      if (key(a)[d] != key(b)[d]) return key(a)[d] < key(b)[d];
    }
    return a < b;
  });
  int32_t before = -1;
  for (const int32_t i : order) {
    if (before >= 0 && std::equal(key(i), key(i) + 3, key(before))) continue;
    kept.push_back(i);
    before = i;
  }
  std::sort(kept.begin(), kept.end());
  return kept;
}

void set_frame(const double* centres, int64_t k, CentreGridTables& tables, Scene& scene) {
  double half[3], widest = 0.0, far = 0.0;
  for (int a = 0; a < 3; ++a) {
    double low = centres[a], high = centres[a];
    for (int64_t i = 1; i < k; ++i) {
      low = std::min(low, centres[3 * i + a]);
      high = std::max(high, centres[3 * i + a]);
    }
    // A regular grid's outermost cells go half a spacing beyond its centres.
    half[a] = 1.125 * (0.5 * high - 0.5 * low);
    tables.frame[a] = static_cast<float>(std::clamp(0.5 * low + 0.5 * high, -1e30, 1e30));
    widest = std::max(widest, half[a]);
    far = std::max({far, std::fabs(low), std::fabs(high)});
  }
  for (int a = 0; a < 3; ++a) {
    // Flat diagrams, single centres, and centres closer than float32 places the middle: cells need some size.
    const double size = std::clamp(std::max({half[a], 0.125 * widest, 1e-6 * far}), 1e-30, 1e30);
    tables.frame[3 + a] = static_cast<float>(1.0 / size);
    scene.middle[a] = static_cast<double>(tables.frame[a]);
    scene.inverse[a] = static_cast<double>(tables.frame[3 + a]);
  }
}

// List of a point, or null beyond the grid's reach.
const int32_t* find_list(const CentreGrid& grid, const double* point) {
  int32_t cell[3];
  for (int a = 0; a < 3; ++a) {
    cell[a] = grid_cell(point[a], static_cast<double>(grid.frame[a]), static_cast<double>(grid.frame[3 + a]));
    if (cell[a] < 0) return nullptr;
  }
  int shift = kCellBits, bits = grid.bits;
  for (int64_t table = 0;; bits = kBrickBits) {
    shift -= bits;
    const int32_t low = (1 << bits) - 1;
    const int64_t inside =
        ((((cell[0] >> shift & low) << bits) + (cell[1] >> shift & low)) << bits) + (cell[2] >> shift & low);
    const int32_t entry = grid.entries[table + inside];
    if (entry >= 0) return grid.lists + entry;
    table = ~entry;
  }
}

void query(const float* points, const float* centres, const CentreGrid& grid, int32_t* cells, int64_t n, Isa isa) {
  VN_FOR_ISA(isa, nearest_centre_grid(points, centres, grid, cells, n))
}

void query(const double* points, const double* centres, const CentreGrid& grid, int32_t* cells, int64_t n, Isa) {
  for (int64_t i = 0; i < n; ++i) {
    const int32_t* list = find_list(grid, points + 3 * i);
    cells[i] = list == nullptr ? -1 : nearest_of_list(points + 3 * i, centres, list);
  }
}

}  // namespace

std::unique_ptr<CentreGridTables> centre_grid_build(const double* centres, int64_t k, Isa isa, int threads) {
  auto tables = std::make_unique<CentreGridTables>();
  Scene scene;
  scene.isa = isa;
  scene.bits = kTop;
  while (scene.bits < 6 && int64_t{1} << 3 * scene.bits < 8 * k) ++scene.bits;
  tables->bits = scene.bits;
  set_frame(centres, k, *tables, scene);
  scene.centres = centres;

  std::vector<std::vector<int32_t>> level = {distinct(centres, static_cast<int32_t>(k))};
  for (int depth = 1; depth <= kTop; ++depth) {
    const int side = 1 << depth;
    std::vector<std::vector<int32_t>> next(int64_t{1} << 3 * depth);
    parallel_for(static_cast<int64_t>(next.size()), 1, threads, [&](int64_t item) {
      const int i = static_cast<int>(item);
      const int32_t cell[3] = {i / side / side, i / side % side, i % side};
      const int parent = ((cell[0] / 2) * (side / 2) + cell[1] / 2) * (side / 2) + cell[2] / 2;
      const List list{level[parent].data(), static_cast<int32_t>(level[parent].size()), -1};
      std::vector<double> workspace;
      scene.prune(depth, cell, list, next[i], workspace);
    });
    level = std::move(next);
  }

  // int32 of memory: typical tables hold 20 a root cell and 60 a centre; a task may need more than its part.
  const int64_t total = (int64_t{64} << 3 * scene.bits) + 256 * k;
  std::vector<std::unique_ptr<Task>> tasks(kTasks);
  parallel_for(kTasks, 1, threads, [&](int64_t item) {
    const int i = static_cast<int>(item);
    const int32_t cell[3] = {i >> 2 * kTop, i >> kTop & ((1 << kTop) - 1), i & ((1 << kTop) - 1)};
    tasks[i] = std::make_unique<Task>(scene, total / 64, 32 * k + 65536);
    tasks[i]->build(cell, {level[i].data(), static_cast<int32_t>(level[i].size()), -1});
  });

  // The parts of the root grid lie as blocks in it, the bricks behind it.
  const int inner = scene.bits - kTop, side = 1 << inner;
  const int64_t root = int64_t{1} << 3 * scene.bits, part = int64_t{1} << 3 * inner;
  std::vector<int64_t> bricks(kTasks + 1, root), places(kTasks + 1, 0);
  for (int i = 0; i < kTasks; ++i) {
    bricks[i + 1] = bricks[i] + static_cast<int64_t>(tasks[i]->entries.size()) - part;
    places[i + 1] = places[i] + static_cast<int64_t>(tasks[i]->lists.size());
  }
  VN_CHECK(bricks[kTasks] <= INT32_MAX && places[kTasks] <= INT32_MAX, "centre_grid: too many centres for one grid");
  tables->entries.resize(bricks[kTasks]);
  tables->lists.resize(places[kTasks]);
  parallel_for(kTasks, 1, threads, [&](int64_t item) {
    const int i = static_cast<int>(item);
    const Task& task = *tasks[i];
    std::copy(task.lists.begin(), task.lists.end(), tables->lists.begin() + places[i]);
    const int64_t x0 = int64_t{i >> 2 * kTop} << inner, y0 = int64_t{i >> kTop & ((1 << kTop) - 1)} << inner;
    const int64_t z0 = int64_t{i & ((1 << kTop) - 1)} << inner;
    for (int64_t e = 0; e < static_cast<int64_t>(task.entries.size()); ++e) {
      const int64_t x = x0 + e / side / side, y = y0 + e / side % side, z = z0 + e % side;
      const int64_t to = e < part ? (((x << scene.bits) + y) << scene.bits) + z : bricks[i] + e - part;
      const int32_t entry = task.entries[e];
      tables->entries[to] = static_cast<int32_t>(entry >= 0 ? entry + places[i] : ~(bricks[i] + ~entry - part));
    }
  });
  return tables;
}

template <typename T>
void nearest_centre_grid_cpu(const T* points, const T* centres, const CentreGrid& grid, int32_t* cells, int64_t n,
                             int64_t k, Isa isa, int threads) {
  parallel_for(ceil_div(n, kBlock), 1, threads, [&](int64_t b) {
    const int64_t start = b * kBlock, rows = std::min(kBlock, n - start);
    query(points + 3 * start, centres, grid, cells + start, rows, isa);
    // What the grid does not reach goes through all centres together.
    T far[3 * kBlock];
    int32_t where[kBlock], found[kBlock];
    int64_t count = 0;
    for (int64_t i = start; i < start + rows; ++i) {
      if (cells[i] >= 0) continue;
      std::copy(points + 3 * i, points + 3 * i + 3, far + 3 * count);
      where[count++] = static_cast<int32_t>(i - start);
    }
    if (count == 0) return;
    nearest_centre_serial(far, centres, found, count, k, isa);
    for (int64_t i = 0; i < count; ++i) cells[start + where[i]] = found[i];
  });
}

template void nearest_centre_grid_cpu(const float*, const float*, const CentreGrid&, int32_t*, int64_t, int64_t, Isa,
                                      int);
template void nearest_centre_grid_cpu(const double*, const double*, const CentreGrid&, int32_t*, int64_t, int64_t, Isa,
                                      int);

}  // namespace voronerf
