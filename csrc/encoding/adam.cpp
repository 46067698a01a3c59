// Adam on the CPU: threads share blocks of entries. Entries are independent, so results do not depend on the number of
// threads.
#include "encoding/adam.h"

#include <algorithm>
#include <cmath>

#include "common/parallel.h"
#include "encoding/adam_isa.h"

namespace voronerf {

namespace {

constexpr int64_t kBlock = 1 << 14;  // entries of one task, 64 KiB of the gradient

void run_block(Isa isa, const AdamStep& rule, const float* gradient, float* parameter, float* mean, float* square,
               int64_t begin, int64_t end) {
  VN_FOR_ISA(isa, adam_block(rule, gradient, parameter, mean, square, begin, end))
}

bool all_below(Isa isa, float limit, const float* gradient, int64_t n) {
  VN_FOR_ISA(isa, adam_all_below(limit, gradient, n))
}

// Returns whether the step is skipped, and counts skipped steps.
bool is_skipped(const std::vector<AdamRule>& rules, const AdamGuard& guard, const float* const* gradients,
                const std::vector<int64_t>& sizes, Isa isa) {
  if (guard.loss != nullptr) {
    bool fine = std::fabs(*guard.loss) < guard.limit;
    for (size_t i = 0; i < sizes.size() && fine; ++i) {
      fine = !rules[i].dense || all_below(isa, guard.limit, gradients[i], sizes[i]);
    }
    *guard.skip = fine ? 0.0f : 1.0f;
    *guard.skipped += *guard.skip;
    *guard.in_a_row = (*guard.in_a_row + 1.0f) * *guard.skip;
  }
  return guard.skip != nullptr && *guard.skip != 0.0f;
}

// Increments the rule's step and returns its bias-corrected constants.
AdamStep next_step(const AdamRule& rule) {
  const double step = static_cast<double>(*rule.step += 1.0f);
  const double root = std::pow(1.0 - std::pow(rule.decay_sq, step), 0.5);
  const double rate = rule.rate_at == nullptr ? rule.rate : *rule.rate_at;
  return {static_cast<float>(rate * root / (1.0 - std::pow(rule.decay, step))),
          static_cast<float>(rule.decay),
          static_cast<float>(rule.decay_sq),
          static_cast<float>(1.0 - rule.decay),
          static_cast<float>(1.0 - rule.decay_sq),
          static_cast<float>(rule.epsilon * root),
          rule.dense};
}

// Calls body(tensor, begin, end) for the blocks of all tensors.
template <typename Body>
void for_blocks(const std::vector<int64_t>& sizes, int threads, const Body& body) {
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
    body(i, begin, std::min(sizes[i], begin + kBlock));
  });
}

}  // namespace

void adam_cpu(const std::vector<AdamRule>& rules, float* const* parameters, const float* const* gradients,
              float* const* means, float* const* squares, const AdamGuard& guard, const std::vector<int64_t>& sizes,
              Isa isa, int threads) {
  if (is_skipped(rules, guard, gradients, sizes, isa)) return;
  std::vector<AdamStep> steps;
  for (const AdamRule& rule : rules) steps.push_back(next_step(rule));
  for_blocks(sizes, threads, [&](size_t i, int64_t begin, int64_t end) {
    run_block(isa, steps[i], gradients[i], parameters[i], means[i], squares[i], begin, end);
  });
}

void average_cpu(float* const* averages, const float* const* parameters, const float* share,
                 const std::vector<int64_t>& sizes, int threads) {
  for_blocks(sizes, threads, [&, share = *share](size_t i, int64_t begin, int64_t end) {
    float* __restrict__ average = averages[i];
    if (parameters == nullptr) {
      for (int64_t j = begin; j < end; ++j) average[j] *= 1.0f - share;
      return;
    }
    const float* __restrict__ parameter = parameters[i];
    const float kept = 1.0f - share;
    if (share < 0.5f) {
      for (int64_t j = begin; j < end; ++j) average[j] += share * (parameter[j] - average[j]);
    } else {  // as torch.lerp; exact for a share of 1
      for (int64_t j = begin; j < end; ++j) average[j] = parameter[j] - kept * (parameter[j] - average[j]);
    }
  });
}

}  // namespace voronerf
