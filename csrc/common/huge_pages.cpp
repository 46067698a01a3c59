#include "common/huge_pages.h"

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace voronerf {

#if defined(__linux__) && defined(MADV_HUGEPAGE)

namespace {

constexpr std::uintptr_t kHugePage = std::uintptr_t{1} << 21;

}  // namespace

void advise_huge_pages(void* memory, int64_t bytes) {
  const std::uintptr_t start = reinterpret_cast<std::uintptr_t>(memory);
  // Advise only huge pages that lie entirely in the block: the memory around the block belongs to others.
  const std::uintptr_t first = (start + kHugePage - 1) / kHugePage * kHugePage;
  const std::uintptr_t last = (start + static_cast<std::uintptr_t>(bytes)) / kHugePage * kHugePage;
  // On an error the pages stay small.
  if (first < last) (void)madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
}

#else

void advise_huge_pages(void*, int64_t) {}

#endif

}  // namespace voronerf
