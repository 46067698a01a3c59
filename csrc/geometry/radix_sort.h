// The toolkit's radix sort (CUB) behind functions of plain types, so that one file alone includes it; the emulation of
// the tests has one of its own. Stable, by the lowest `bits` of the keys.
#pragma once

#include <cstdint>

namespace voronerf {

// Bytes of temporary memory for a sort of n keys on the current device, known to the host.
template <typename Key>
int64_t radix_sort_bytes(int64_t n, int bits);

// Input and output do not overlap. Key: uint16_t or uint32_t.
template <typename Key>
void radix_sort(void* temporary, int64_t bytes, const Key* keys, Key* sorted, const int32_t* values,
                int32_t* sorted_values, int64_t n, int bits, void* stream);

}  // namespace voronerf
