// Stable sort by cell on CUDA. Bucket 0 is for cells below 0 and bucket k + 1 for cells from k on. Few cells are sorted
// by counting, in chunks as on the CPU. One warp owns a chunk, so that no counter is shared:
//
//   1. cell_sort_chunk    the chunk's histogram, counts[bucket][chunk]
//   2. scan_*             exclusive scan of counts in that order: the first position, in the sorted order, of each
//                         bucket's rows of each chunk
//   3. cell_sort_chunk    writes the rows to their positions, in order
//
// A warp takes 32 rows at a time; rows with the same bucket find each other with __match_any_sync, are ranked by lane,
// and the first of their lanes advances the counter, in shared memory. There are no atomics. In global memory the
// counters of a block's eight chunks are adjacent, one sector of 32 bytes per bucket, and are copied to and from shared
// memory in this layout.
//
// If a warp has too few counters for the cells, the toolkit's radix sort sorts by the bits of the bucket numbers. With
// counters in global memory every 32 rows would wait for a counter, and the many counters would allow too few chunks to
// fill the device (for 4 M rows, 256 warps with 4,096 cells and 16 with 65,536). cell_sort_keys writes buckets and row
// numbers for the radix sort, and cell_sort_offsets finds each cell's first row in the sorted keys.
//
// A stable order is unique, so both methods give the CPU's result bit for bit.
#include "common/cuda_wrappers.h"
#include "common/index_maps.h"
#include "geometry/cell_sort.h"
#include "geometry/radix_sort.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr unsigned kWarps = kThreads / 32;
static_assert(kWarps == kCellSortBlock, "the plan has whole blocks of chunks");
constexpr int kAhead = 4;  // steps of 32 rows that are read ahead
constexpr int kScanThreads = 1024;
constexpr int64_t kScanTile = kCellSortScanTile;
constexpr int kScanItems = static_cast<int>(kScanTile) / kScanThreads;

// Calls place(row, position) for every row of the warp's chunk; position is the value of the bucket's counter before
// the row is counted. Counters belong to this warp alone; __syncwarp makes the write of one lane visible to the lane
// that reads next. While the cells of kAhead x 32 rows are counted, the cells of the next rows are being loaded.
template <typename Place>
__device__ void count_rows(const int32_t* cells, int32_t* counters, int64_t begin, int64_t end, int64_t k,
                           Place place) {
  const int lane = threadIdx.x % 32;
  const auto read = [&](int64_t start, int32_t (&ahead)[kAhead]) {
#pragma unroll
    for (int step = 0; step < kAhead; ++step) {
      const int64_t row = start + 32 * step + lane;
      ahead[step] = row < end ? cells[row] : 0;
    }
  };
  int32_t now[kAhead], next[kAhead];
  read(begin, now);
  for (int64_t start = begin; start < end; start += 32 * kAhead) {
    read(start + 32 * kAhead, next);
#pragma unroll
    for (int step = 0; step < kAhead; ++step) {
      const int64_t row = start + 32 * step + lane;
      const bool active = row < end;
      // Lanes past the end form a separate group, which counts nothing.
      const int bucket = active ? static_cast<int>(bucket_of_cell(now[step], k)) : -1;
      const unsigned peers = __match_any_sync(kAllLanes, bucket);
      const int leader = __ffs(static_cast<int>(peers)) - 1;
      int32_t before = 0;
      if (active && lane == leader) {
        before = counters[bucket];
        counters[bucket] = before + __popc(peers);
      }
      before = __shfl_sync(kAllLanes, before, leader);
      if (active) place(row, before + __popc(peers & ((1u << lane) - 1u)));
      __syncwarp();
      now[step] = next[step];
    }
  }
}

// Processes the chunks of a block's warps, with their counters in shared memory: counts rows, or (kScatter) writes rows
// to their places. The grid has whole blocks of chunks; the last chunks may have no rows.
template <bool kScatter>
__global__ void __launch_bounds__(kThreads)
    cell_sort_chunk(const int32_t* __restrict__ cells, int32_t* counts, int32_t* __restrict__ order, int64_t chunks,
                    int64_t rows, int64_t n, int64_t k) {
  // Four padding counters per warp: neighbouring threads access one bucket's counters of eight warps, in different
  // banks.
  VN_SHARED(counters, int32_t[kWarps][kCellSortBuckets + 4]);
  const unsigned warp = threadIdx.x / 32, size = static_cast<unsigned>(k + 2) * kWarps;
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kWarps;
  for (unsigned i = threadIdx.x; i < size; i += kThreads) {
    counters[i % kWarps][i / kWarps] = kScatter ? counts[i / kWarps * chunks + first + i % kWarps] : 0;
  }
  __syncthreads();
  const int64_t begin = (first + warp) * rows, end = begin + rows < n ? begin + rows : n;
  if constexpr (kScatter) {
    count_rows(cells, counters[warp], begin, end, k,
               [order](int64_t row, int32_t position) { order[position] = static_cast<int32_t>(row); });
  } else {
    count_rows(cells, counters[warp], begin, end, k, [](int64_t, int32_t) {});
    __syncthreads();
    for (unsigned i = threadIdx.x; i < size; i += kThreads) {
      counts[i / kWarps * chunks + first + i % kWarps] = counters[i % kWarps][i / kWarps];
    }
  }
}

// Returns the exclusive scan over the kScanThreads threads of a block, and their sum in `total`. `warp_sums` is shared
// scratch.
__device__ int32_t scan_block(int32_t value, int32_t* warp_sums, int32_t& total) {
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  int32_t inclusive = value;
  for (int step = 1; step < 32; step *= 2) {
    const int32_t other = __shfl_up_sync(kAllLanes, inclusive, step);
    if (lane >= step) inclusive += other;
  }
  if (lane == 31) warp_sums[warp] = inclusive;
  __syncthreads();
  if (warp == 0) {
    int32_t sum = warp_sums[lane];
    for (int step = 1; step < 32; step *= 2) {
      const int32_t other = __shfl_up_sync(kAllLanes, sum, step);
      if (lane >= step) sum += other;
    }
    warp_sums[lane] = sum;
  }
  __syncthreads();
  total = warp_sums[31];
  const int32_t before = warp == 0 ? 0 : warp_sums[warp - 1];
  __syncthreads();  // the scratch is free for the next call
  return before + inclusive - value;
}

__global__ void __launch_bounds__(kScanThreads)
    scan_sums(const int32_t* __restrict__ counts, int32_t* __restrict__ tile_sums, int64_t size) {
  VN_SHARED(warp_sums, int32_t[32]);
  const int64_t first = blockIdx.x * kScanTile + static_cast<int64_t>(threadIdx.x) * kScanItems;
  int32_t sum = 0, total;
  for (int item = 0; item < kScanItems; ++item) {
    if (first + item < size) sum += counts[first + item];
  }
  scan_block(sum, warp_sums, total);
  if (threadIdx.x == 0) tile_sums[blockIdx.x] = total;
}

// Replaces the sums of the tiles by their exclusive scan, in one block.
__global__ void __launch_bounds__(kScanThreads) scan_tiles(int32_t* tile_sums, int64_t tiles) {
  VN_SHARED(warp_sums, int32_t[32]);
  int32_t carry = 0;
  for (int64_t start = 0; start < tiles; start += kScanThreads) {
    const int64_t i = start + threadIdx.x;
    int32_t total;
    const int32_t before = scan_block(i < tiles ? tile_sums[i] : 0, warp_sums, total);
    if (i < tiles) tile_sums[i] = carry + before;
    carry += total;
  }
}

// Replaces counts by positions in the sorted order; offsets[c] is the first position of bucket c + 1.
__global__ void __launch_bounds__(kScanThreads)
    scan_places(int32_t* __restrict__ counts, const int32_t* __restrict__ tile_sums, int32_t* __restrict__ offsets,
                int64_t size, int64_t chunks) {
  VN_SHARED(warp_sums, int32_t[32]);
  const int64_t first = blockIdx.x * kScanTile + static_cast<int64_t>(threadIdx.x) * kScanItems;
  int32_t value[kScanItems], sum = 0, total;
  for (int item = 0; item < kScanItems; ++item) {
    value[item] = first + item < size ? counts[first + item] : 0;
    sum += value[item];
  }
  int32_t place = tile_sums[blockIdx.x] + scan_block(sum, warp_sums, total);
  for (int item = 0; item < kScanItems; ++item) {
    const int64_t i = first + item;
    if (i >= size) break;
    counts[i] = place;
    if (i % chunks == 0 && i >= chunks) offsets[i / chunks - 1] = place;
    place += value[item];
  }
}

template <typename Key>
__global__ void __launch_bounds__(kThreads) cell_sort_keys(const int32_t* __restrict__ cells, Key* __restrict__ keys,
                                                           int32_t* __restrict__ rows, int64_t n, int64_t k) {
  const int64_t row = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= n) return;
  keys[row] = static_cast<Key>(bucket_of_cell(cells[row], k));
  rows[row] = static_cast<int32_t>(row);
}

// Finds the first row of each cell by bisection, one thread per cell: a few steps in cache for any distribution of
// rows.
template <typename Key>
__global__ void __launch_bounds__(kThreads)
    cell_sort_offsets(const Key* __restrict__ sorted, int32_t* __restrict__ offsets, int64_t n, int64_t k) {
  const int64_t cell = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (cell > k) return;
  offsets[cell] = static_cast<int32_t>(first_above(sorted, n, cell));  // the bucket of cell c is c + 1
}

unsigned blocks_of(int64_t threads) { return static_cast<unsigned>(ceil_div<int64_t>(threads, kThreads)); }

// Returns the plan for the current device.
CellSortPlan plan_of(int64_t n, int64_t k, CellSortWay way) {
  CellSortPlan plan = cell_sort_plan(n, k, way, 0);
  if (!plan.radix || n == 0) return plan;
  const bool narrow = plan.key_bytes == 2;
  return cell_sort_plan(n, k, way,
                        narrow ? radix_sort_bytes<uint16_t>(n, plan.bits) : radix_sort_bytes<uint32_t>(n, plan.bits));
}

void sort_by_counting(const CellSortPlan& plan, const int32_t* cells, int32_t* order, int32_t* offsets,
                      unsigned char* workspace, int64_t n, int64_t k, void* stream) {
  const int64_t rows = plan.chunk_rows, chunks = plan.chunks, size = chunks * plan.buckets;
  const unsigned tiles = static_cast<unsigned>(plan.tiles);
  const unsigned blocks = static_cast<unsigned>(chunks / kWarps);
  auto* counts = reinterpret_cast<int32_t*>(workspace + plan.counts);
  auto* tile_sums = reinterpret_cast<int32_t*>(workspace + plan.tile_sums);
  VN_LAUNCH(cell_sort_chunk<false>, blocks, kThreads, 0, stream, cells, counts, order, chunks, rows, n, k);
  VN_LAUNCH(scan_sums, tiles, kScanThreads, 0, stream, counts, tile_sums, size);
  VN_LAUNCH(scan_tiles, 1, kScanThreads, 0, stream, tile_sums, plan.tiles);
  VN_LAUNCH(scan_places, tiles, kScanThreads, 0, stream, counts, tile_sums, offsets, size, chunks);
  VN_LAUNCH(cell_sort_chunk<true>, blocks, kThreads, 0, stream, cells, counts, order, chunks, rows, n, k);
}

template <typename Key>
void sort_by_radix(const CellSortPlan& plan, const int32_t* cells, int32_t* order, int32_t* offsets,
                   unsigned char* workspace, int64_t n, int64_t k, void* stream) {
  auto* keys = reinterpret_cast<Key*>(workspace + plan.keys);
  auto* sorted = reinterpret_cast<Key*>(workspace + plan.sorted);
  auto* rows = reinterpret_cast<int32_t*>(workspace + plan.rows);
  VN_LAUNCH((cell_sort_keys<Key>), blocks_of(n), kThreads, 0, stream, cells, keys, rows, n, k);
  radix_sort(workspace + plan.temporary, plan.bytes - plan.temporary, keys, sorted, rows, order, n, plan.bits, stream);
  VN_LAUNCH((cell_sort_offsets<Key>), blocks_of(k + 1), kThreads, 0, stream, sorted, offsets, n, k);
}

}  // namespace

int64_t cell_sort_workspace_cuda(int64_t n, int64_t k, CellSortWay way) { return plan_of(n, k, way).bytes; }

void cell_sort_cuda(const int32_t* cells, int32_t* order, int32_t* offsets, unsigned char* workspace, int64_t n,
                    int64_t k, CellSortWay way, void* stream) {
  const CellSortPlan plan = plan_of(n, k, way);
  if (n == 0) {
    VN_CUDA_CHECK(cudaMemsetAsync(offsets, 0, sizeof(int32_t) * (k + 1), static_cast<cudaStream_t>(stream)));
    return;
  }
  if (!plan.radix) return sort_by_counting(plan, cells, order, offsets, workspace, n, k, stream);
  if (plan.key_bytes == 2) return sort_by_radix<uint16_t>(plan, cells, order, offsets, workspace, n, k, stream);
  sort_by_radix<uint32_t>(plan, cells, order, offsets, workspace, n, k, stream);
}

}  // namespace voronerf
