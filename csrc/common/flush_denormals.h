// A scope in which denormals (below 1.2e-38 in float32) are read and written as zero. An operation on a denormal costs
// some hundred cycles. A softplus of sharpness 100 has denormal slopes wherever its argument is below -0.87.
#pragma once

#include <cstdint>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace voronerf {

// Flushes the denormals of the calling thread, and restores its setting at the end of the scope.
class FlushDenormals {
 public:
  FlushDenormals() : before_(control()) { control(before_ | kFlush); }
  ~FlushDenormals() { control(before_); }
  FlushDenormals(const FlushDenormals&) = delete;
  FlushDenormals& operator=(const FlushDenormals&) = delete;

 private:
#if defined(__x86_64__)
  static constexpr uint64_t kFlush = 0x8040;  // flush denormal results (0x8000) and operands (0x40)
  static uint64_t control() { return _mm_getcsr(); }
  static void control(uint64_t value) { _mm_setcsr(static_cast<unsigned>(value)); }
#elif defined(__aarch64__)
  static constexpr uint64_t kFlush = uint64_t{1} << 24;  // flushes results and operands
  static uint64_t control() {
    uint64_t value;
    __asm__ volatile("mrs %0, fpcr" : "=r"(value));
    return value;
  }
  static void control(uint64_t value) { __asm__ volatile("msr fpcr, %0" : : "r"(value)); }
#else
  static constexpr uint64_t kFlush = 0;
  static uint64_t control() { return 0; }
  static void control(uint64_t) {}
#endif

  const uint64_t before_;
};

}  // namespace voronerf
