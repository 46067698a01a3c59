// Blocks of entries over threads. An entry depends on itself alone, so results do not depend on the threads.
#include <algorithm>

#include "common/parallel.h"
#include "encoding/adam.h"
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

void adam_cpu(const std::vector<SparseAdam>& rules, const float* const* gradients, float* const* parameters,
              float* const* means, float* const* squares, const std::vector<int64_t>& sizes, Isa isa, int threads) {
  struct Block {
    size_t tensor;
    int64_t begin;
  };
  std::vector<Block> blocks;
  for (size_t i = 0; i < sizes.size(); ++i) {
    for (int64_t begin = 0; begin < sizes[i]; begin += kBlock) blocks.push_back({i, begin});
  }
  parallel_for(static_cast<int64_t>(blocks.size()), 1, threads, [&](int64_t number) {
    const auto [i, begin] = blocks[number];
    run_block(isa, rules[i], gradients[i], parameters[i], means[i], squares[i], begin,
              std::min(sizes[i], begin + kBlock));
  });
}

}  // namespace voronerf
