// Gradients of tables of which a step touches a part: the touched entries alone, for other ranks.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

constexpr int64_t kEntriesOfWord = 32;

// A bit for each of n entries that says whether it is not zero, in words of 32, and behind them these entries. Returns
// the length of the message, which has room for all words and n + 16 entries.
int64_t pack_touched_cpu(const float* gradient, int64_t n, float* message, Isa isa, int threads);

// Adds the entries of a message. Throws std::invalid_argument where it has another length than its bits say.
void add_touched_cpu(const float* message, int64_t length, int64_t n, float* total, Isa isa, int threads);

}  // namespace voronerf
