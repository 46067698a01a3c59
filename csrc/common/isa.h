// Instruction sets of the CPU paths. Every file *_isa.cpp is compiled once per instruction set, with the set's compiler
// flags and VN_ISA. The caller chooses one at run time, so one build runs on any processor of its architecture.
#pragma once

namespace voronerf {

// The instruction sets. With avx512_bf16, networks multiply pairs of bfloat16 where this is allowed, and with amx they
// do so in tile registers. In all other cases both run the same kernels as avx512. The other instruction sets multiply
// float32.
enum class Isa : int { portable = 0, neon, avx2, avx512, avx512_bf16, amx };

// Returns whether this build has the instruction set, and the processor and the operating system can run it.
bool isa_supported(Isa isa);

}  // namespace voronerf

// VN_HAS_HALF: the build has bfloat16 products. From version 10 on, gcc's target pragma and attribute enable them for
// one file or function.
#if defined(__x86_64__) && defined(__GNUC__) && __GNUC__ >= 10 && !defined(__clang__)
#define VN_HAS_HALF 1
#else
#define VN_HAS_HALF 0
#endif

// VN_HAS_TILES: the build has bfloat16 products in tile registers. A process must ask Linux for permission to use them.
#if VN_HAS_HALF && defined(__linux__) && defined(__LP64__)
#define VN_HAS_TILES 1
#else
#define VN_HAS_TILES 0
#endif

// A build has the code paths of its architecture, and the portable one. VN_FOR_ISA dispatches a call to one of them.
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
