// A third of the entries is touched, in no order: a branch for each would be guessed wrong. AVX-512 moves sixteen at
// once.
#include "encoding/touched_entries_isa.h"

#include "common/simd.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int kWord = static_cast<int>(kEntriesOfWord);

// Packs `entries` of a word to `to`, and counts on.
VN_INLINE uint32_t pack_word(const float* from, int entries, float* to, int64_t& count) {
  uint32_t word = 0;
#if VN_ISA == 2
  for (int i = 0; i < entries; i += kLanes) {
    const Mask inside = static_cast<Mask>(entries - i < kLanes ? (1u << (entries - i)) - 1 : 0xffffu);
    const F32 a = _mm512_maskz_loadu_ps(inside, from + i);
    const Mask touched = _mm512_cmp_ps_mask(a, _mm512_setzero_ps(), _CMP_NEQ_UQ);
    _mm512_storeu_ps(to + count, _mm512_maskz_compress_ps(touched, a));
    count += __builtin_popcount(touched);
    word |= static_cast<uint32_t>(touched) << i;
  }
#else
  for (int i = 0; i < entries; ++i) {
    const uint32_t touched = from[i] != 0.0f;
    to[count] = from[i];
    count += touched;
    word |= touched << i;
  }
#endif
  return word;
}

VN_INLINE void add_word(uint32_t word, const float* from, float* to) {
#if VN_ISA == 2
  for (; word != 0; word >>= kLanes, to += kLanes) {
    const Mask touched = static_cast<Mask>(word & 0xffffu);
    const int present = __builtin_popcount(touched);
    const F32 a = _mm512_maskz_expand_ps(touched, _mm512_maskz_loadu_ps(static_cast<Mask>((1u << present) - 1), from));
    _mm512_mask_storeu_ps(to, touched, add(_mm512_maskz_loadu_ps(touched, to), a));
    from += present;
  }
#else
  for (; word != 0; word &= word - 1) to[__builtin_ctz(word)] += *from++;
#endif
}

}  // namespace

int64_t pack_touched_entries(const float* gradient, int64_t n, float* message) {
  int64_t count = (n + kWord - 1) / kWord;
  for (int64_t i = 0; i < n; i += kWord) {
    const uint32_t word = pack_word(gradient + i, n - i < kWord ? static_cast<int>(n - i) : kWord, message, count);
    __builtin_memcpy(message + i / kWord, &word, sizeof(word));
  }
  return count;
}

int64_t add_touched_entries(const float* message, int64_t length, int64_t n, float* total) {
  int64_t at = (n + kWord - 1) / kWord;
  for (int64_t i = 0; i < n; i += kWord) {
    uint32_t word;
    __builtin_memcpy(&word, message + i / kWord, sizeof(word));
    if (n - i < kWord) word &= (1u << (n - i)) - 1;
    const int present = __builtin_popcount(word);
    if (at + present > length) return length + 1;
    add_word(word, message + at, total + i);
    at += present;
  }
  return at;
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
