// The AMX instructions for bfloat16 products, on eight registers of up to 16 rows of 64 bytes. The portable path
// emulates them, so that every machine can test the kernels that use them.
//
//   shape_tiles    sets each register's number of rows and bytes per row, and zeros all registers
//   tile_load      loads rows `stride` bytes apart
//   tile_store     stores rows `stride` bytes apart
//   tile_products  C[m][n] += sum over k of A[m][2k] B[k][2n] + A[m][2k+1] B[k][2n+1], with B in pairs of
//                  rows. Sums are float32, rounded to the nearest; denormals are 0.
//   release_tiles  releases the registers
//
// The shapes belong to the thread, which releases them after the products: otherwise the operating system would save
// the registers at every context switch.
#pragma once

#include "common/memory_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int64_t kTileRows = 16, kTileBytes = 64;

struct alignas(64) TileShapes {
  uint8_t palette = 1, start = 0, none[14] = {};
  uint16_t bytes[16] = {};
  uint8_t rows[16] = {};
};

#if VN_ISA == 2

VN_INLINE void shape_tiles(const TileShapes& shapes) { asm volatile("ldtilecfg %0" ::"m"(shapes)); }
VN_INLINE void release_tiles() { asm volatile("tilerelease"); }
template <int T>
VN_INLINE void tile_load(const void* from, int64_t stride) {
  asm volatile("tileloadd (%0,%1,1), %%tmm%c2" ::"r"(from), "r"(stride), "i"(T) : "memory");
}
template <int T>
VN_INLINE void tile_store(void* to, int64_t stride) {
  asm volatile("tilestored %%tmm%c2, (%0,%1,1)" ::"r"(to), "r"(stride), "i"(T) : "memory");
}
template <int C, int A, int B>
VN_INLINE void tile_products() {
  asm volatile("tdpbf16ps %%tmm%c2, %%tmm%c1, %%tmm%c0" ::"i"(C), "i"(A), "i"(B));
}

#else

struct Tile {
  int64_t rows, bytes;
  unsigned char data[kTileRows][kTileBytes];
};
// Returns the registers of the calling thread.
inline Tile* tiles() {
  static thread_local Tile registers[8];
  return registers;
}

VN_INLINE void shape_tiles(const TileShapes& shapes) {
  for (int i = 0; i < 8; ++i) tiles()[i] = {shapes.rows[i], shapes.bytes[i], {}};
}
VN_INLINE void release_tiles() { shape_tiles({}); }
template <int T>
void tile_load(const void* from, int64_t stride) {
  Tile& tile = tiles()[T];
  const auto* row = static_cast<const unsigned char*>(from);
  for (int64_t i = 0; i < tile.rows; ++i, row += stride) __builtin_memcpy(tile.data[i], row, tile.bytes);
}
template <int T>
void tile_store(void* to, int64_t stride) {
  const Tile& tile = tiles()[T];
  auto* row = static_cast<unsigned char*>(to);
  for (int64_t i = 0; i < tile.rows; ++i, row += stride) __builtin_memcpy(row, tile.data[i], tile.bytes);
}
template <int C, int A, int B>
void tile_products() {
  Tile& c = tiles()[C];
  const Tile &a = tiles()[A], &b = tiles()[B];
  constexpr int64_t kValues = kTileBytes / 2;
  float left[kTileRows][kValues], right[kTileRows][kValues];
  const auto widen = [](const Tile& tile, float (*to)[kValues]) {  // bfloat16 is the upper half of a float
    uint16_t halves[kValues];
    for (int64_t row = 0; row < tile.rows; ++row) {
      __builtin_memcpy(halves, tile.data[row], sizeof halves);
      for (int64_t i = 0; i < kValues; ++i) {
        const uint32_t bits = static_cast<uint32_t>(halves[i]) << 16;
        __builtin_memcpy(to[row] + i, &bits, sizeof bits);
      }
    }
  };
  widen(a, left);
  widen(b, right);
  for (int64_t m = 0; m < c.rows; ++m) {
    float sums[kValues / 2], odd[kValues / 2] = {}, even[kValues / 2] = {};
    for (int64_t k = 0; k < a.bytes / 4; ++k) {
      for (int64_t n = 0; n < c.bytes / 4; ++n) {
        even[n] += left[m][2 * k] * right[k][2 * n];
        odd[n] += left[m][2 * k + 1] * right[k][2 * n + 1];
      }
    }
    __builtin_memcpy(sums, c.data[m], sizeof sums);
    for (int64_t n = 0; n < c.bytes / 4; ++n) sums[n] += even[n] + odd[n];
    __builtin_memcpy(c.data[m], sums, sizeof sums);
  }
}

#endif

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
