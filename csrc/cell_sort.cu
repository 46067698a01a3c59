// Stable counting sort on CUDA, in the same chunks as on the CPU. One warp owns a chunk, so that no counter is shared:
//
//   1. cell_sort_count    the chunk's histogram, counts[bucket][chunk]
//   2. scan_*             exclusive scan of counts in that order: the first place of each bucket's rows of each chunk
//   3. cell_sort_scatter  the rows go to their places, in order
//
// A warp takes 32 rows at a time; rows with the same bucket find each other with __match_any_sync, are ranked by lane,
// and their first lane moves the counter. There are no atomics, and every row has one possible place: the result is
// that of the CPU, bit for bit. Bucket 0 is for cells below 0 and bucket k + 1 for cells from k on.
#include "cell_sort.h"
#include "cuda_wrappers.h"
#include "launchers.h"

namespace voronerf {

namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;
constexpr int kAhead = 4;             // steps of 32 rows that are read before they are counted
constexpr int kSharedBuckets = 1024;  // of a warp: 32 KiB of a block
constexpr int kScanThreads = 1024;
constexpr int kScanItems = static_cast<int>(kScanTile) / kScanThreads;
constexpr unsigned kAll = 0xffffffffu;

__device__ int64_t bucket_of(int32_t cell, int64_t k) {
  return cell < 0 ? 0 : cell >= k ? k + 1 : cell + 1;
}

// Calls place(row, position) for every row of the warp's chunk, where position is the value of the row's counter before
// it; the counter of bucket b is counters[b * stride]. Counters belong to this warp alone; __syncwarp makes the write
// of one lane visible to the lane that reads next. Cells are read some steps ahead.
template <typename Place>
__device__ void count_rows(const int32_t* cells, int32_t* counters, int64_t stride, int64_t chunk, int64_t rows,
                           int64_t n, int64_t k, Place place) {
  const int lane = threadIdx.x % 32;
  const int64_t end = (chunk + 1) * rows < n ? (chunk + 1) * rows : n;
  for (int64_t start = chunk * rows; start < end; start += 32 * kAhead) {
    int32_t ahead[kAhead];
#pragma unroll
    for (int step = 0; step < kAhead; ++step) {
      const int64_t row = start + 32 * step + lane;
      ahead[step] = row < end ? cells[row] : 0;
    }
#pragma unroll
    for (int step = 0; step < kAhead; ++step) {
      const int64_t row = start + 32 * step + lane;
      const bool active = row < end;
      // Lanes past the end form a group of their own, which counts nothing.
      const int64_t bucket = active ? bucket_of(ahead[step], k) : -1;
      const unsigned peers = __match_any_sync(kAll, static_cast<int>(bucket));
      const int leader = __ffs(static_cast<int>(peers)) - 1;
      int32_t before = 0;
      if (active && lane == leader) {
        int32_t* counter = counters + bucket * stride;
        before = *counter;
        *counter = before + __popc(peers);
      }
      before = __shfl_sync(kAll, before, leader);
      if (active) place(row, before + __popc(peers & ((1u << lane) - 1u)));
      __syncwarp();
    }
  }
}

// The same with the chunk's counters in shared memory, where they fit: a warp waits for one at every step.
template <bool kShared, bool kWriteBack, typename Place>
__device__ void count_chunk(const int32_t* cells, int32_t* counts, int64_t chunks, int64_t rows, int64_t n, int64_t k,
                            Place place) {
  const int64_t chunk = static_cast<int64_t>(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (chunk >= chunks) return;  // whole warps leave; there is no barrier of the block
  if constexpr (kShared) {
    VN_SHARED(counters, int32_t[kWarps][kSharedBuckets]);
    int32_t* own = counters[threadIdx.x / 32];
    for (int64_t bucket = threadIdx.x % 32; bucket < k + 2; bucket += 32) own[bucket] = counts[bucket * chunks + chunk];
    __syncwarp();
    count_rows(cells, own, 1, chunk, rows, n, k, place);
    if constexpr (kWriteBack) {
      for (int64_t bucket = threadIdx.x % 32; bucket < k + 2; bucket += 32) {
        counts[bucket * chunks + chunk] = own[bucket];
      }
    }
  } else {
    count_rows(cells, counts + chunk, chunks, chunk, rows, n, k, place);
  }
}

template <bool kShared>
__global__ void __launch_bounds__(kThreads) cell_sort_count(const int32_t* __restrict__ cells, int32_t* counts,
                                                            int64_t chunks, int64_t rows, int64_t n, int64_t k) {
  count_chunk<kShared, true>(cells, counts, chunks, rows, n, k, [](int64_t, int32_t) {});
}

template <bool kShared>
__global__ void __launch_bounds__(kThreads)
    cell_sort_scatter(const int32_t* __restrict__ cells, int32_t* counts, int32_t* __restrict__ order, int64_t chunks,
                      int64_t rows, int64_t n, int64_t k) {
  count_chunk<kShared, false>(cells, counts, chunks, rows, n, k,
                              [order](int64_t row, int32_t position) { order[position] = static_cast<int32_t>(row); });
}

// Exclusive scan over the threads of a block of kScanThreads; `total` is the sum of all. `warp_sums` is shared scratch.
__device__ int32_t scan_block(int32_t value, int32_t* warp_sums, int32_t& total) {
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  int32_t inclusive = value;
  for (int step = 1; step < 32; step *= 2) {
    const int32_t other = __shfl_up_sync(kAll, inclusive, step);
    if (lane >= step) inclusive += other;
  }
  if (lane == 31) warp_sums[warp] = inclusive;
  __syncthreads();
  if (warp == 0) {
    int32_t sum = warp_sums[lane];
    for (int step = 1; step < 32; step *= 2) {
      const int32_t other = __shfl_up_sync(kAll, sum, step);
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

// One block turns the sums of the tiles into their exclusive scan.
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

// Counts become places, and the first place of bucket c + 1 is offsets[c].
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

}  // namespace

void cell_sort_cuda(const int32_t* cells, int32_t* order, int32_t* offsets, int32_t* workspace, int64_t n, int64_t k,
                    void* stream_pointer) {
  const cudaStream_t stream = static_cast<cudaStream_t>(stream_pointer);
  if (n == 0) {
    VN_CUDA_CHECK(cudaMemsetAsync(offsets, 0, sizeof(int32_t) * (k + 1), stream));
    return;
  }
  const int64_t rows = cell_sort_chunk_rows(k), chunks = cell_sort_chunks(n, k), size = chunks * (k + 2);
  const unsigned tiles = static_cast<unsigned>(ceil_div(size, kScanTile));
  const unsigned blocks = static_cast<unsigned>(ceil_div<int64_t>(chunks, kWarps));
  int32_t* counts = workspace;
  int32_t* tile_sums = workspace + size;
  VN_CUDA_CHECK(cudaMemsetAsync(counts, 0, sizeof(int32_t) * size, stream));
  const bool shared = k + 2 <= kSharedBuckets;
  if (shared) {
    VN_LAUNCH(cell_sort_count<true>, blocks, kThreads, 0, stream, cells, counts, chunks, rows, n, k);
  } else {
    VN_LAUNCH(cell_sort_count<false>, blocks, kThreads, 0, stream, cells, counts, chunks, rows, n, k);
  }
  VN_LAUNCH(scan_sums, tiles, kScanThreads, 0, stream, counts, tile_sums, size);
  VN_LAUNCH(scan_tiles, 1, kScanThreads, 0, stream, tile_sums, tiles);
  VN_LAUNCH(scan_places, tiles, kScanThreads, 0, stream, counts, tile_sums, offsets, size, chunks);
  if (shared) {
    VN_LAUNCH(cell_sort_scatter<true>, blocks, kThreads, 0, stream, cells, counts, order, chunks, rows, n, k);
  } else {
    VN_LAUNCH(cell_sort_scatter<false>, blocks, kThreads, 0, stream, cells, counts, order, chunks, rows, n, k);
  }
}

}  // namespace voronerf
