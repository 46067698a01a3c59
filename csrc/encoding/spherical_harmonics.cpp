// Spherical harmonics on the CPU: blocks of rows for each thread. A row depends on its direction alone, so the result
// does not depend on the number of threads.
#include "encoding/spherical_harmonics.h"

#include <algorithm>

#include "common/common.h"
#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr int64_t kBlock = 1024;

template <typename Run>
void over_blocks(int64_t n, int threads, const Run& run) {
  parallel_for(ceil_div(n, kBlock), 1, threads, [&](int64_t i) { run(i * kBlock, std::min(kBlock, n - i * kBlock)); });
}

void forward_rows(const float* directions, float* out, int64_t n, int64_t degree, Isa isa) {
  VN_FOR_ISA(isa, harmonics_rows(directions, out, n, degree))
}

void backward_rows(const float* directions, const float* gradient, float* grad_directions, int64_t n, int64_t degree,
                   Isa isa) {
  VN_FOR_ISA(isa, harmonics_rows_backward(directions, gradient, grad_directions, n, degree))
}

}  // namespace

void spherical_harmonics_cpu(const float* directions, float* out, int64_t n, int64_t degree, Isa isa, int threads) {
  over_blocks(n, threads, [&](int64_t first, int64_t rows) {
    forward_rows(directions + 3 * first, out + degree * degree * first, rows, degree, isa);
  });
}

void spherical_harmonics_backward_cpu(const float* directions, const float* gradient, float* grad_directions, int64_t n,
                                      int64_t degree, Isa isa, int threads) {
  over_blocks(n, threads, [&](int64_t first, int64_t rows) {
    backward_rows(directions + 3 * first, gradient + degree * degree * first, grad_directions + 3 * first, rows, degree,
                  isa);
  });
}

}  // namespace voronerf
