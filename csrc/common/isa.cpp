#include "common/isa.h"

namespace voronerf {

bool isa_supported(Isa isa) {
#if defined(__x86_64__)
  __builtin_cpu_init();
  switch (isa) {
    case Isa::avx512:
      return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
             __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma");
    case Isa::avx2:
      return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    default:
      return true;
  }
#else
  return isa == Isa::portable;
#endif
}

bool isa_multiplies_bfloat16(Isa isa) {
#if VN_HAS_HALF
  return isa == Isa::avx512 && isa_supported(isa) && __builtin_cpu_supports("avx512bf16");
#else
  return static_cast<void>(isa), false;
#endif
}

}  // namespace voronerf
