// Instruction sets of the CPU paths. Every file *_isa.cpp is compiled once for each, with its own flags and VN_ISA set;
// the caller names one at run time, so one build runs on any processor of its architecture.
#pragma once

namespace voronerf {

// avx512_bf16 is avx512 whose networks multiply pairs of bfloat16 where they may, amx one that does so in tile
// registers; the others multiply floats.
enum class Isa : int { portable = 0, neon, avx2, avx512, avx512_bf16, amx };

// Whether this build has it, and this processor and its operating system can run it.
bool isa_supported(Isa isa);

}  // namespace voronerf

// Whether the build has bfloat16 products: gcc's target pragma and attribute give them to one file or function, from
// version 10 on.
#if defined(__x86_64__) && defined(__GNUC__) && __GNUC__ >= 10 && !defined(__clang__)
#define VN_HAS_HALF 1
#else
#define VN_HAS_HALF 0
#endif

// Whether it has them in tile registers, for which Linux is to be asked.
#if VN_HAS_HALF && defined(__linux__) && defined(__LP64__)
#define VN_HAS_TILES 1
#else
#define VN_HAS_TILES 0
#endif

// The paths that exist in a build: those of its architecture, and the portable one.
#define VN_DECLARE_IN(isa, declaration) \
  namespace isa {                       \
  declaration;                          \
  }
#if defined(__x86_64__)
#define VN_FOR_ISA(isa, call)            \
  switch (isa) {                         \
    case ::voronerf::Isa::avx512:        \
    case ::voronerf::Isa::avx512_bf16:   \
    case ::voronerf::Isa::amx:           \
      return ::voronerf::avx512::call;   \
    case ::voronerf::Isa::avx2:          \
      return ::voronerf::avx2::call;     \
    default:                             \
      return ::voronerf::portable::call; \
  }
#define VN_DECLARE_FOR_ISA(declaration) \
  VN_DECLARE_IN(portable, declaration)  \
  VN_DECLARE_IN(avx2, declaration)      \
  VN_DECLARE_IN(avx512, declaration)
#elif defined(__aarch64__)
#define VN_FOR_ISA(isa, call)                                      \
  if (isa == ::voronerf::Isa::neon) return ::voronerf::neon::call; \
  return ::voronerf::portable::call;
#define VN_DECLARE_FOR_ISA(declaration) \
  VN_DECLARE_IN(portable, declaration)  \
  VN_DECLARE_IN(neon, declaration)
#else
#define VN_FOR_ISA(isa, call) \
  (void)isa;                  \
  return ::voronerf::portable::call;
#define VN_DECLARE_FOR_ISA(declaration) VN_DECLARE_IN(portable, declaration)
#endif
