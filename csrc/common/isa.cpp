#include "common/isa.h"

#if VN_HAS_TILES
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace voronerf {

namespace {

#if VN_HAS_TILES
// Returns whether the processor has tile registers with bfloat16 products, and Linux permits this process to use them.
// Linux is asked once for all threads, and a child process inherits the permission.
bool tiles_allowed() {
  constexpr unsigned kFeatures = 7, kBfloat16 = 1u << 22, kTiles = 1u << 24;
  constexpr long kAskFor = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
  unsigned a = 0, b = 0, c = 0, d = 0;
  if (__get_cpuid_count(kFeatures, 0, &a, &b, &c, &d) == 0 || (d & kBfloat16) == 0 || (d & kTiles) == 0) return false;
  static const bool allowed = syscall(SYS_arch_prctl, kAskFor, kTileData) == 0;
  return allowed;
}
#endif

}  // namespace

bool isa_supported(Isa isa) {
#if defined(__x86_64__)
  __builtin_cpu_init();
  switch (isa) {
#if VN_HAS_TILES
    case Isa::amx:
      return isa_supported(Isa::avx512_bf16) && tiles_allowed();
#endif
#if VN_HAS_HALF
    case Isa::avx512_bf16:
      return __builtin_cpu_supports("avx512bf16") && isa_supported(Isa::avx512);
#endif
    case Isa::avx512:
      return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
             __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma");
    case Isa::avx2:
      return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    default:
      return isa == Isa::portable;
  }
#elif defined(__aarch64__)
  return isa == Isa::portable || isa == Isa::neon;  // every aarch64 processor has NEON
#else
  return isa == Isa::portable;
#endif
}

}  // namespace voronerf
