#include "common/measure_peak.h"

#include <atomic>
#include <chrono>
#include <cstring>
#include <memory>
#include <new>
#include <stdexcept>

#include "common/measure_peak_isa.h"
#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr double kBurst = 1.5e-3, kSeconds = 0.1;
constexpr int64_t kCopied = int64_t{1} << 24;  // floats in each of two buffers of 64 MiB
constexpr int64_t kLine = 64;

double now() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

int64_t run_float32(Isa isa, int64_t turns, float* sink) { VN_FOR_ISA(isa, peak_float32(turns, sink)) }

void stream(Isa isa, const float* from, float* to, int64_t floats){VN_FOR_ISA(isa, peak_copy(from, to, floats))}

int64_t multiply_adds(Peak kind, Isa isa, int64_t turns, float* sink) {
#if VN_HAS_HALF
  if (kind == Peak::bfloat16) {
    return isa == Isa::amx ? avx512::peak_tiles(turns, sink) : avx512::peak_bfloat16(turns, sink);
  }
#else
  (void)kind;
#endif
  return run_float32(isa, turns, sink);
}

double measure_multiply_adds(Peak kind, Isa isa, int threads) {
  alignas(kLine) float sink[16] = {};
  int64_t turns = 1000;
  const double start = now();
  const double flops_a_turn = static_cast<double>(multiply_adds(kind, isa, turns, sink));
  for (double took = 0; took < kBurst; turns *= 2) {
    const double begin = now();
    multiply_adds(kind, isa, turns, sink);
    took = now() - begin;
  }
  double best = 0;
  do {
    std::atomic<int> members{0};
    const double begin = now();
    parallel(threads, [&](int) {
      alignas(kLine) float sums[16] = {};
      ++members;
      multiply_adds(kind, isa, turns, sums);
    });
    best = std::max(best, members * flops_a_turn * static_cast<double>(turns) / (now() - begin));
  } while (now() - start < kSeconds);
  return best;
}

double measure_copy(Isa isa, int threads) {
  struct Free {
    void operator()(float* memory) const { ::operator delete(memory, std::align_val_t{kLine}); }
  };
  const std::unique_ptr<float, Free> memory(
      static_cast<float*>(::operator new(2 * kCopied * sizeof(float), std::align_val_t{kLine})));
  float *from = memory.get(), *to = from + kCopied;
  constexpr int64_t kPiece = 1 << 16;
  std::atomic<int64_t> copied{0};
  const auto copy = [&](bool streaming) {
    copied = 0;
    // Each thread copies the same pieces in every call, so it writes to pages that it was the first to touch.
    parallel(threads, [&](int thread) {
      for (int64_t at = thread * kPiece; at < kCopied; at += threads * kPiece, copied += kPiece) {
        if (streaming) {
          stream(isa, from + at, to + at, kPiece);
        } else {
          std::memcpy(to + at, from + at, kPiece * sizeof(float));
        }
      }
    });
  };
  std::memset(from, 0, kCopied * sizeof(float));
  copy(false);
  double best = 0;
  const double start = now();
  bool streaming = false;
  do {
    const double begin = now();
    copy(streaming);
    // A team smaller than `threads` copies only some of the pieces.
    best = std::max(best, 2.0 * static_cast<double>(copied) * sizeof(float) / (now() - begin));
    streaming = !streaming;
  } while (now() - start < kSeconds);
  return best;
}

}  // namespace

double bfloat16_gain() {
  if (!isa_supported(Isa::avx512_bf16)) return 0;
  constexpr int64_t kTurns = 4000, kRounds = 8;
  constexpr Peak kKinds[] = {Peak::float32, Peak::bfloat16};
  alignas(kLine) float sink[16] = {};
  double most[2] = {};
  // The two kinds alternate, so that a rising clock and other processes affect both. The best round of each counts.
  for (int64_t round = 0; round < kRounds; ++round) {
    for (int i = 0; i < 2; ++i) {
      const double begin = now();
      const double flops = static_cast<double>(multiply_adds(kKinds[i], Isa::avx512_bf16, kTurns, sink) * kTurns);
      most[i] = std::max(most[i], flops / (now() - begin));
    }
  }
  return most[1] / most[0];
}

double measure_peak(Peak kind, Isa isa, int threads) {
  if (!isa_supported(isa)) throw std::invalid_argument("measure_peak: isa must be one that this processor supports");
  if (kind == Peak::bfloat16 && isa != Isa::avx512_bf16 && isa != Isa::amx) {
    throw std::invalid_argument("measure_peak: the instruction set has no bfloat16 products");
  }
  return kind == Peak::copy ? measure_copy(isa, threads) : measure_multiply_adds(kind, isa, threads);
}

}  // namespace voronerf
