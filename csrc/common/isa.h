// Instruction sets of the CPU paths. Every file *_isa.cpp is compiled once for each, with its own flags and VN_ISA set;
// the caller names one at run time, so one build runs on any processor of its architecture.
#pragma once

namespace voronerf {

enum class Isa : int { portable = 0, avx2 = 1, avx512 = 2 };

// Whether this processor and its operating system can run it.
bool isa_supported(Isa isa);

// Whether the processor multiplies pairs of bfloat16, and the build has code for it.
bool isa_multiplies_bfloat16(Isa isa);

}  // namespace voronerf

// Whether the build has bfloat16 products: gcc's target pragma and attribute give them to one file or function, from
// version 10 on.
#if defined(__x86_64__) && defined(__GNUC__) && __GNUC__ >= 10 && !defined(__clang__)
#define VN_HAS_HALF 1
#else
#define VN_HAS_HALF 0
#endif

// The paths that exist in a build. x86-64 has all three, anything else the portable one.
#if defined(__x86_64__)
#define VN_FOR_ISA(isa, call)            \
  switch (isa) {                         \
    case ::voronerf::Isa::avx512:        \
      return ::voronerf::avx512::call;   \
    case ::voronerf::Isa::avx2:          \
      return ::voronerf::avx2::call;     \
    default:                             \
      return ::voronerf::portable::call; \
  }
#define VN_DECLARE_FOR_ISA(declaration) \
  namespace portable {                  \
  declaration;                          \
  }                                     \
  namespace avx2 {                      \
  declaration;                          \
  }                                     \
  namespace avx512 {                    \
  declaration;                          \
  }
#else
#define VN_FOR_ISA(isa, call) \
  (void)isa;                  \
  return ::voronerf::portable::call;
#define VN_DECLARE_FOR_ISA(declaration) \
  namespace portable {                  \
  declaration;                          \
  }
#endif
