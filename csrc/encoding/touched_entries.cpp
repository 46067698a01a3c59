// On one thread: ranks of a machine have few each.
#include "encoding/touched_entries.h"

#include <stdexcept>
#include <string>

#include "encoding/touched_entries_isa.h"

namespace voronerf {

namespace {

int64_t pack(Isa isa, const float* gradient, int64_t n,
             float* message){VN_FOR_ISA(isa, pack_touched_entries(gradient, n, message))}

int64_t add(Isa isa, const float* message, int64_t length, int64_t n, float* total) {
  VN_FOR_ISA(isa, add_touched_entries(message, length, n, total))
}

}  // namespace

int64_t pack_touched_cpu(const float* gradient, int64_t n, float* message, Isa isa, int) {
  return pack(isa, gradient, n, message);
}

void add_touched_cpu(const float* message, int64_t length, int64_t n, float* total, Isa isa, int) {
  const int64_t words = (n + kEntriesOfWord - 1) / kEntriesOfWord;
  if (length < words || add(isa, message, length, n, total) != length) {
    throw std::invalid_argument("add_touched: the bits of a message must tell its length, got " +
                                std::to_string(length) + " numbers for " + std::to_string(n) + " entries");
  }
}

}  // namespace voronerf
