// The twins of the instructions in csrc/network/cuda/cuda_wgmma.h. A product is done when it is waited for, as late as it may be on
// a GPU, its sums unreadable until then; what its operands were when it began they must be still. What is written down
// here comes from the PTX manual, "Asynchronous Warpgroup Level Matrix-Multiply-Accumulate Instructions", and knows
// nothing of how a kernel packs its weights.
#pragma once

#include "emulation.h"

namespace voronerf {

// Whether registers have passed a fence as they are.
inline bool emulated_is_fenced(const void* registers, size_t size) {
  const auto& fenced = vn_emulation::group_thread().fenced;
  return std::any_of(fenced.begin(), fenced.end(), [&](const vn_emulation::GroupRegisters& each) {
    const auto offset = static_cast<const char*>(registers) - static_cast<const char*>(each.at);
    return offset >= 0 && offset + size <= each.bytes.size() &&
           std::memcmp(each.bytes.data() + offset, registers, size) == 0;
  });
}

inline void emulated_publish() {
  vn_emulation::group_thread().unpublished.clear();
}

inline uint32_t emulated_shared_address(const void* shared) {
  const ptrdiff_t offset = static_cast<const char*>(shared) - static_cast<const char*>(vn_emulation::dynamic_shared());
  if (reinterpret_cast<uintptr_t>(shared) % 16 != 0) vn_emulation::misaligned("wgmma");
  if (offset < 0 || offset >= static_cast<ptrdiff_t>(vn_emulation::dynamic_bytes())) {
    vn_emulation::fail("an operand of wgmma outside of the dynamic shared memory");
  }
  return vn_emulation::kSharedWindow + static_cast<uint32_t>(offset);
}

inline void emulated_settle(const void* registers, size_t size) {
  const auto* bytes = static_cast<const unsigned char*>(registers);
  vn_emulation::group_thread().settled.push_back({bytes, {bytes, bytes + size}});
}

inline void emulated_group_fence() {
  vn_emulation::agree("wgmma.fence", 0);
  auto& thread = vn_emulation::group_thread();
  for (auto& registers : thread.settled) thread.fenced.push_back(std::move(registers));
  thread.settled.clear();
}

inline void emulated_group_commit() {
  vn_emulation::agree("wgmma.commit_group", 0);
  ++vn_emulation::group_thread().sets;
}

// Element [n][k] of a right operand: the canonical layout of a K-major matrix without swizzling.
inline const unsigned char* emulated_place(uint64_t descriptor, int n, int k) {
  const auto field = [&](int bit) { return static_cast<ptrdiff_t>(descriptor >> bit & 0x3fff) * 16; };
  const ptrdiff_t place = field(0) - vn_emulation::kSharedWindow + n / 8 * field(32) + k / 8 * field(16) + n % 8 * 16 +
                          k % 8 * static_cast<ptrdiff_t>(sizeof(uint16_t));
  if (place < 0 || place + 2 > static_cast<ptrdiff_t>(vn_emulation::dynamic_bytes())) {
    vn_emulation::fail("wgmma reads outside of the dynamic shared memory");
  }
  return static_cast<const unsigned char*>(vn_emulation::dynamic_shared()) + place;
}

inline void emulated_group_multiply(float* d, int tiles, const uint32_t (&a)[4], uint64_t b, bool bfloat16) {
  constexpr uint64_t kFields = 0x00003fff3fff3fffu;
  static const char* const kNames[2][4] = {{"m64n8k16.f16", "m64n16k16.f16", "m64n32k16.f16", "m64n64k16.f16"},
                                           {"m64n8k16.bf16", "m64n16k16.bf16", "m64n32k16.bf16", "m64n64k16.bf16"}};
  const char* name = kNames[bfloat16][tiles == 1 ? 0 : tiles == 2 ? 1 : tiles == 4 ? 2 : 3];
  if ((b & ~kFields) != 0)
    vn_emulation::fail("the emulation has no descriptor with an offset of the base or swizzling");
  vn_emulation::agree(name, b);
  auto& thread = vn_emulation::group_thread();
  const size_t size = tiles * 4 * sizeof(float);
  auto sums = std::find_if(thread.sums.begin(), thread.sums.end(), [&](const auto& each) { return each.at == d; });
  if (sums == thread.sums.end()) {
    if (!emulated_is_fenced(d, size)) vn_emulation::fail("wgmma takes sums that have passed no fence");
    thread.sums.push_back({d, {d, d + tiles * 4}});
    sums = thread.sums.end() - 1;
    std::fill(d, d + tiles * 4, vn_emulation::kUnderWay);
  } else if (sums->values.size() != static_cast<size_t>(tiles) * 4) {
    vn_emulation::fail("products of two shapes share sums without a fence");
  }
  if (!emulated_is_fenced(a, sizeof a)) vn_emulation::fail("wgmma takes a left operand that has passed no fence");
  // Of what threads copied and did not publish; one of the group looks, since all name the same matrix.
  if (threadIdx.x % 128 == 0) {
    for (const void* copied : vn_emulation::unpublished()) {
      for (int core = 0; core < 2 * tiles; ++core) {
        const auto* first = emulated_place(b, core / 2 * 8, core % 2 * 8);
        if (copied >= first && copied < first + 128) vn_emulation::fail("wgmma reads copies that were not published");
      }
    }
  }
  vn_emulation::GroupProduct product = {d, tiles, bfloat16, thread.sets, b, a, {a[0], a[1], a[2], a[3]}, {}};
  const unsigned char* slots = vn_emulation::meet(name, a, sizeof a);
  for (int member = 0; member < 4; ++member) {
    std::memcpy(product.rows[member], slots + (vn_emulation::lane() / 4 * 4 + member) * vn_emulation::kSlot, sizeof a);
  }
  thread.products.push_back(product);
}

inline void emulated_group_wait(int pending) {
  vn_emulation::agree("wgmma.wait_group", static_cast<uint64_t>(pending));
  auto& thread = vn_emulation::group_thread();
  const int lane = vn_emulation::lane();
  size_t done = 0;
  for (; done < thread.products.size() && thread.products[done].set < thread.sets - pending; ++done) {
    const vn_emulation::GroupProduct& product = thread.products[done];
    if (std::memcmp(product.a, product.kept, sizeof product.kept) != 0) {
      vn_emulation::fail("the left operand of a product under way was changed");
    }
    auto sums = std::find_if(thread.sums.begin(), thread.sums.end(), [&](const auto& s) { return s.at == product.d; });
    float rows[2][16];
    for (int half = 0; half < 2; ++half) {
      for (int k = 0; k < 16; ++k) {
        rows[half][k] = half_value(product.rows[k % 8 / 2][half + 2 * (k / 8)] >> (16 * (k % 2)), product.bfloat16);
      }
    }
    for (int i = 0; i < 4 * product.tiles; ++i) {
      const int column = i / 4 * 8 + 2 * (lane % 4) + i % 2;
      double sum = sums->values[i];
      for (int k = 0; k < 16; ++k) {
        sum += static_cast<double>(rows[i % 4 / 2][k]) *
               half_value(*reinterpret_cast<const uint16_t*>(emulated_place(product.b, column, k)), product.bfloat16);
      }
      sums->values[i] = static_cast<float>(sum);
    }
  }
  thread.products.erase(thread.products.begin(), thread.products.begin() + static_cast<ptrdiff_t>(done));
  for (size_t s = 0; s < thread.sums.size();) {
    vn_emulation::GroupSums& sums = thread.sums[s];
    const bool under_way = std::any_of(thread.products.begin(), thread.products.end(),
                                       [&](const auto& product) { return product.d == sums.at; });
    if (under_way) {
      ++s;
      continue;
    }
    for (size_t i = 0; i < sums.values.size(); ++i) {
      if (std::memcmp(&sums.at[i], &vn_emulation::kUnderWay, sizeof(float)) != 0) {
        vn_emulation::fail("sums of a product under way were written");
      }
    }
    std::copy(sums.values.begin(), sums.values.end(), sums.at);
    thread.sums.erase(thread.sums.begin() + static_cast<ptrdiff_t>(s));
  }
  // Whoever waits is about to use registers: what comes next passes a fence again.
  if (done > 0) thread.fenced.clear();
}

}  // namespace voronerf
