// Huge memory pages for large results.
#pragma once

#include <cstdint>

namespace voronerf {

// Asks for huge pages in fresh memory [memory, memory + bytes), where Linux gives them on request
// (/sys/kernel/mm/transparent_hugepage/enabled: madvise). The first touch of a fresh page, small or huge, costs about a
// microsecond in addition to zeroing the page: 64 MiB are 16,384 small pages or 32 huge ones. Results do not depend on
// the request, which is a no-op on other systems.
void advise_huge_pages(void* memory, int64_t bytes);

}  // namespace voronerf
