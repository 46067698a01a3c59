#include <cub/device/device_radix_sort.cuh>

#include "common/common.h"
#include "geometry/radix_sort.h"

namespace voronerf {

template <typename Key>
int64_t radix_sort_bytes(int64_t n, int bits) {
  size_t bytes = 0;
  const Key* keys = nullptr;
  const int32_t* values = nullptr;
  VN_CUDA_CHECK(cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, const_cast<Key*>(keys), values,
                                                const_cast<int32_t*>(values), static_cast<int32_t>(n), 0, bits));
  return static_cast<int64_t>(bytes);
}

template <typename Key>
void radix_sort(void* temporary, int64_t bytes, const Key* keys, Key* sorted, const int32_t* values,
                int32_t* sorted_values, int64_t n, int bits, void* stream) {
  size_t size = static_cast<size_t>(bytes);
  VN_CUDA_CHECK(cub::DeviceRadixSort::SortPairs(temporary, size, keys, sorted, values, sorted_values,
                                                static_cast<int32_t>(n), 0, bits, static_cast<cudaStream_t>(stream)));
}

template int64_t radix_sort_bytes<uint16_t>(int64_t, int);
template int64_t radix_sort_bytes<uint32_t>(int64_t, int);
template void radix_sort(void*, int64_t, const uint16_t*, uint16_t*, const int32_t*, int32_t*, int64_t, int, void*);
template void radix_sort(void*, int64_t, const uint32_t*, uint32_t*, const int32_t*, int32_t*, int64_t, int, void*);

}  // namespace voronerf
