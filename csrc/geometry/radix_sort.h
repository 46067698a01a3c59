// The toolkit's radix sort (CUB) behind functions with plain types, so that only one file includes CUB. The tests'
// emulation replaces these functions. The sort is stable and uses the lowest `bits` bits of the keys.
#pragma once

#include <cstdint>

namespace voronerf {

// Returns the bytes of temporary memory for a sort of n keys on the current device; computed on the host.
template <typename Key>
int64_t radix_sort_bytes(int64_t n, int bits);

// Sorts keys [n], and reorders values [n] in the same way. Inputs and outputs must not overlap. `temporary` has `bytes`
// bytes. Key: uint16_t or uint32_t.
template <typename Key>
void radix_sort(void* temporary, int64_t bytes, const Key* keys, Key* sorted, const int32_t* values,
                int32_t* sorted_values, int64_t n, int bits, void* stream);

}  // namespace voronerf
