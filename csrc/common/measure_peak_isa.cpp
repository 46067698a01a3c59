// Each loop has enough independent sums to hide the latency of a multiply-add on two units (up to 5 cycles), in at most
// 13 of 16 registers or 24 of 32. The unroll pragma is needed because gcc unrolls at most 16 by default. The sums start
// with different values, since the compiler would compute only one of several equal sums.
#include "common/measure_peak_isa.h"

#include "common/memory_tile.h"
#include "network/cpu/tile_registers.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {

int64_t peak_float32(int64_t turns, float* sink) {
  constexpr int kSums = kRegisters == 32 ? 24 : VN_ISA == 1 ? 12 : 10;
  F32 sums[kSums];
#pragma GCC unroll 24
  for (int i = 0; i < kSums; ++i) sums[i] = splat(static_cast<float>(i));
  const F32 a = splat(0.999f), b = splat(1e-3f);
  for (int64_t turn = 0; turn < turns; ++turn) {
#pragma GCC unroll 24
    for (int i = 0; i < kSums; ++i) sums[i] = fma(sums[i], a, b);
  }
#pragma GCC unroll 24
  for (int i = 0; i < kSums; ++i) store(sink, sums[i] + load(sink));
  return 2 * kLanes * kSums;
}

#if VN_ISA == 2 && VN_HAS_HALF
__attribute__((target("avx512bf16"))) int64_t peak_bfloat16(int64_t turns, float* sink) {
  constexpr int kSums = 24;
  F32 sums[kSums];
#pragma GCC unroll 24
  for (int i = 0; i < kSums; ++i) sums[i] = splat(static_cast<float>(i));
  const __m512bh a = _mm512_cvtne2ps_pbh(splat(0.5f), splat(0.5f)), b = a;
  for (int64_t turn = 0; turn < turns; ++turn) {
#pragma GCC unroll 24
    for (int i = 0; i < kSums; ++i) sums[i] = _mm512_dpbf16_ps(sums[i], a, b);
  }
#pragma GCC unroll 24
  for (int i = 0; i < kSums; ++i) store(sink, sums[i] + load(sink));
  return 4 * kLanes * kSums;
}

int64_t peak_tiles(int64_t turns, float* sink) {
  TileShapes shapes;
  for (int i = 0; i < 8; ++i) shapes.rows[i] = kTileRows, shapes.bytes[i] = kTileBytes;
  shape_tiles(shapes);
  for (int64_t turn = 0; turn < turns; ++turn) {
    tile_products<0, 4, 6>();
    tile_products<1, 5, 6>();
    tile_products<2, 4, 7>();
    tile_products<3, 5, 7>();
  }
  tile_store<0>(sink, 0);
  release_tiles();
  constexpr int64_t kRegisters = 4, kValues = kTileBytes / 2;
  return kRegisters * 2 * kTileRows * kTileRows * kValues;
}
#endif

void peak_copy(const float* from, float* to, int64_t floats) {
#if VN_ISA == 2
  for (int64_t i = 0; i < floats; i += kLanes) _mm512_stream_ps(to + i, load(from + i));
  _mm_sfence();
#elif VN_ISA == 1
  for (int64_t i = 0; i < floats; i += kLanes) _mm256_stream_ps(to + i, load(from + i));
  _mm_sfence();
#else
  __builtin_memcpy(to, from, sizeof(float) * floats);
#endif
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
