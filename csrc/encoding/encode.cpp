// The encodings on the CPU: a range of whole tiles for each thread. A row's encoding depends on that row alone, so the
// result does not depend on the number of threads.
#include "encoding/encode.h"

#include <algorithm>

#include "common/common.h"
#include "common/parallel.h"

namespace voronerf {

namespace {

int64_t stride_of(int64_t d, int64_t octaves) { return ceil_div(d * (1 + 2 * octaves), kEncodeLanes) * kEncodeLanes; }

// Table, encoded rows, staged rows with a vector to spare, staged variances.
int64_t workspace_of_thread(int64_t d, int64_t octaves) {
  return (3 + kEncodeRows) * stride_of(d, octaves) + 2 * (kEncodeRows * d + kEncodeLanes);
}

template <typename Run>
void over_ranges(const Encoding& in, float* workspace, int threads, const Run& run) {
  if (in.n == 0 || in.d == 0) return;
  const int64_t tiles = ceil_div(in.n, kEncodeRows);
  const int64_t ranges = std::min<int64_t>(std::max(threads, 1), tiles);
  const int64_t rows = ceil_div(tiles, ranges) * kEncodeRows;
  parallel_for(ranges, 1, threads, [&](int64_t i) {
    run(workspace + i * workspace_of_thread(in.d, in.octaves), std::min(in.n, i * rows),
        std::min(in.n, (i + 1) * rows));
  });
}

void forward_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin, int64_t end,
                  Isa isa) {
  VN_FOR_ISA(isa, encode_rows(in, out, workspace, stride, begin, end))
}

void backward_rows(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances, float* workspace,
                   int64_t stride, int64_t begin, int64_t end, Isa isa) {
  VN_FOR_ISA(isa, encode_rows_backward(in, gradient, grad_x, grad_variances, workspace, stride, begin, end))
}

}  // namespace

int64_t encode_workspace(int64_t d, int64_t octaves, int threads) {
  return std::max(threads, 1) * workspace_of_thread(d, octaves);
}

void encode_cpu(const Encoding& in, float* out, float* workspace, Isa isa, int threads) {
  if (in.width == 0) return;
  const int64_t stride = stride_of(in.d, in.octaves);
  over_ranges(in, workspace, threads,
              [&](float* own, int64_t begin, int64_t end) { forward_rows(in, out, own, stride, begin, end, isa); });
}

void encode_backward_cpu(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                         float* workspace, Isa isa, int threads) {
  const int64_t stride = stride_of(in.d, in.octaves);
  over_ranges(in, workspace, threads, [&](float* own, int64_t begin, int64_t end) {
    backward_rows(in, gradient, grad_x, grad_variances, own, stride, begin, end, isa);
  });
}

}  // namespace voronerf
