// The encodings on the CPU. Each thread encodes a range of whole tiles. A row's encoding depends on this row alone, so
// the result does not depend on the number of threads.
#include "encoding/encode.h"

#include <algorithm>
#include <memory>

#include "common/common.h"
#include "common/parallel.h"

namespace voronerf {

namespace {

void forward_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin, int64_t end,
                  Isa isa) {
  VN_FOR_ISA(isa, encode_rows(in, out, workspace, stride, begin, end))
}

void backward_rows(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances, float* workspace,
                   int64_t stride, int64_t begin, int64_t end, Isa isa) {
  VN_FOR_ISA(isa, encode_rows_backward(in, gradient, grad_x, grad_variances, workspace, stride, begin, end))
}

// Calls run(workspace, stride of encoded rows in it, begin, end) for each thread's range of rows.
template <typename Run>
void over_ranges(const Encoding& in, int threads, const Run& run) {
  if (in.n == 0 || in.d == 0) return;
  const int64_t tiles = ceil_div(in.n, kEncodeRows), ranges = std::min<int64_t>(std::max(threads, 1), tiles);
  const int64_t rows = ceil_div(tiles, ranges) * kEncodeRows;
  const int64_t stride = ceil_div<int64_t>(in.width, kEncodeLanes) * kEncodeLanes;
  struct alignas(64) Line {
    float floats[kEncodeLanes];
  };
  // The workspace of a range holds a table of three rows, the encoded rows of a tile, and copies of the tile's x and
  // variances, each copy with a spare vector.
  const int64_t lines = ceil_div((3 + kEncodeRows) * stride + 2 * (kEncodeRows * in.d + kEncodeLanes), kEncodeLanes);
  const std::unique_ptr<Line[]> workspace(new Line[static_cast<size_t>(ranges * lines)]);
  parallel_for(ranges, 1, threads, [&](int64_t i) {
    run(workspace[i * lines].floats, stride, std::min(in.n, i * rows), std::min(in.n, (i + 1) * rows));
  });
}

}  // namespace

void encode_cpu(const Encoding& in, float* out, Isa isa, int threads) {
  if (in.width == 0) return;
  over_ranges(in, threads, [&](float* workspace, int64_t stride, int64_t begin, int64_t end) {
    forward_rows(in, out, workspace, stride, begin, end, isa);
  });
}

void encode_backward_cpu(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances, Isa isa,
                         int threads) {
  over_ranges(in, threads, [&](float* workspace, int64_t stride, int64_t begin, int64_t end) {
    backward_rows(in, gradient, grad_x, grad_variances, workspace, stride, begin, end, isa);
  });
}

}  // namespace voronerf
