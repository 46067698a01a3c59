// Huge pages of memory for large results.
#pragma once

#include <cstdint>

namespace voronerf {

// Asks for huge pages in fresh memory [memory, memory + bytes), where Linux gives them on request
// (/sys/kernel/mm/transparent_hugepage/enabled: madvise). A fresh page costs its first touch about a microsecond, small
// or huge, besides zeroing it: 64 MiB are 16,384 small pages or 32 huge ones. It is a request: nothing depends on it,
// and elsewhere it does nothing.
void advise_huge_pages(void* memory, int64_t bytes);

}  // namespace voronerf
