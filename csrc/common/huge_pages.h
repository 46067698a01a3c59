// Pages of memory: huge ones for large results, and those that the C library would give back.
#pragma once

#include <cstdint>

namespace voronerf {

// Asks for huge pages in fresh memory [memory, memory + bytes), where Linux gives them on request
// (/sys/kernel/mm/transparent_hugepage/enabled: madvise). A fresh page costs its first touch about a microsecond, small
// or huge, besides zeroing it: 64 MiB are 16,384 small pages or 32 huge ones. It is a request: nothing depends on it,
// and elsewhere it does nothing.
void advise_huge_pages(void* memory, int64_t bytes);

// Has glibc keep up to a gibibyte of freed memory, and take blocks below 32 MiB from there. By its own rules it gives
// back what is freed at the end of a training step, and the next step waits for the same pages again. Elsewhere it does
// nothing.
void keep_freed_memory();

}  // namespace voronerf
