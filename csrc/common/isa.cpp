#include "common/isa.h"

namespace voronerf {

bool isa_supported(Isa isa) {
#if defined(__x86_64__)
  __builtin_cpu_init();
  switch (isa) {
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
  return isa == Isa::portable || isa == Isa::neon;  // which every such processor has
#else
  return isa == Isa::portable;
#endif
}

}  // namespace voronerf
