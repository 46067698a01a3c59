// Blocks of entries over threads. An entry depends on itself alone, so results do not depend on the threads.
#include "encoding/sparse_adam.h"

#include <algorithm>

#include "common/parallel.h"
#include "encoding/sparse_adam_isa.h"

namespace voronerf {

namespace {

constexpr int64_t kBlock = 1 << 14;  // entries of a task, 64 KiB of the gradient

void run_block(Isa isa, const SparseAdam& rule, const float* gradient, float* parameter, float* mean, float* square,
               int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, sparse_adam_block(rule, gradient, parameter, mean, square, begin, end))
}

}  // namespace

void sparse_adam_cpu(const SparseAdam& rule, const float* gradient, float* parameter, float* mean, float* square,
                     int64_t n, Isa isa, int threads) {
  parallel_for((n + kBlock - 1) / kBlock, 1, threads, [&](int64_t block) {
    run_block(isa, rule, gradient, parameter, mean, square, block * kBlock, std::min(n, (block + 1) * kBlock));
  });
}

}  // namespace voronerf
