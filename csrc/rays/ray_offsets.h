// The check of ray offsets.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>

namespace voronerf {

// Throws std::invalid_argument unless offsets [r+1] never decrease and lie in 0..m.
inline void check_ray_offsets(const std::string& op, const int32_t* offsets, int64_t r, int64_t m) {
  int64_t before = 0;
  for (int64_t i = 0; i <= r; ++i) {
    if (offsets[i] < before || offsets[i] > m) {
      throw std::invalid_argument(op + ": ray_offsets must ascend within 0 to " + std::to_string(m) +
                                  " (the number of samples), got " + std::to_string(offsets[i]) + " for ray " +
                                  std::to_string(i));
    }
    before = offsets[i];
  }
}

}  // namespace voronerf
