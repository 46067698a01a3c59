// Replaces csrc/geometry/radix_sort.cu, the CUDA toolkit's radix sort, which g++ cannot compile: a stable sort by the
// same bits, with strict checks of its arguments. The calling code is the code that runs on a GPU.
#include "geometry/radix_sort.h"

#include <algorithm>
#include <cstring>
#include <numeric>
#include <stdexcept>
#include <vector>

namespace voronerf {

template <typename Key>
int64_t radix_sort_bytes(int64_t n, int bits) {
  return 1000 + n + bits;
}

template <typename Key>
void radix_sort(void* temporary, int64_t bytes, const Key* keys, Key* sorted, const int32_t* values,
                int32_t* sorted_values, int64_t n, int bits, void*) {
  if (bytes < radix_sort_bytes<Key>(n, bits)) throw std::runtime_error("radix_sort: too little temporary memory");
  if (reinterpret_cast<uintptr_t>(temporary) % 16 != 0) throw std::runtime_error("radix_sort: memory not aligned");
  if (bits < 1 || bits > static_cast<int>(8 * sizeof(Key))) throw std::runtime_error("radix_sort: bits of no key");
  const uint64_t mask = (uint64_t{1} << bits) - 1;
  std::vector<int64_t> order(n);
  std::iota(order.begin(), order.end(), int64_t{0});
  std::stable_sort(order.begin(), order.end(),
                   [&](int64_t a, int64_t b) { return (keys[a] & mask) < (keys[b] & mask); });
  // The real sort may write all of its temporary memory.
  std::memset(temporary, 0xff, bytes);
  for (int64_t i = 0; i < n; ++i) {
    sorted[i] = keys[order[i]];
    sorted_values[i] = values[order[i]];
  }
}

template int64_t radix_sort_bytes<uint16_t>(int64_t, int);
template int64_t radix_sort_bytes<uint32_t>(int64_t, int);
template void radix_sort(void*, int64_t, const uint16_t*, uint16_t*, const int32_t*, int32_t*, int64_t, int, void*);
template void radix_sort(void*, int64_t, const uint32_t*, uint32_t*, const int32_t*, int32_t*, int64_t, int, void*);

}  // namespace voronerf
