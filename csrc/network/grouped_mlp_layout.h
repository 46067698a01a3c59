// Shared by the plans of grouped_mlp for the CPU and for CUDA.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "network/grouped_mlp_encoding.h"

namespace voronerf {

// Features of `raw` values after their encoding.
inline int64_t encoded_width(int64_t raw, const MlpEncoding& encoding) {
  switch (encoding.kind) {
    case MlpEncodingKind::none:
      return raw;
    case MlpEncodingKind::frequency:
      return raw * (1 + 2 * encoding.size);
    case MlpEncodingKind::integrated:
      return raw * encoding.size;
    case MlpEncodingKind::hash:
      return encoding.size;
    default:
      return int64_t{encoding.size} * encoding.size;
  }
}

// Buffers whose lifetimes do not overlap share memory: first fit, in the order of asking. A lifetime is closed at both
// ends.
class Arena {
 public:
  int64_t take(int64_t size, int64_t start, int64_t end) {
    int64_t offset = 0;
    for (bool moved = true; moved;) {
      moved = false;
      for (const Block& other : blocks_) {
        const bool together = start <= other.end && other.start <= end;
        if (together && offset < other.offset + other.size && other.offset < offset + size) {
          offset = other.offset + other.size;
          moved = true;
        }
      }
    }
    blocks_.push_back({offset, size, start, end});
    total_ = std::max(total_, offset + size);
    return offset;
  }
  int64_t total() const { return total_; }

 private:
  struct Block {
    int64_t offset, size, start, end;
  };
  std::vector<Block> blocks_;
  int64_t total_ = 0;
};

}  // namespace voronerf
