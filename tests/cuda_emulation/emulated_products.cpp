// Warp-level products: emulates mma.sync with the fragment layouts of the PTX manual (section "Matrix fragments for
// mma.m16n8k16" and the next ones). Compiled without sanitizers, since products touch only registers.
#include <vector>

#include "emulation.h"

namespace voronerf {

namespace {

struct Fragments {
  uint32_t a[4], b[2];
};

// A table of all float16 values: without hardware support, the conversion takes longer than the product.
std::vector<float> all_halves() {
  std::vector<float> values(1 << 16);
  for (unsigned bits = 0; bits < values.size(); ++bits) values[bits] = half_value(bits, false);
  return values;
}

float float_of(uint32_t bits) {
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

// d += a b for a [16][kDepth] and b [kDepth][8], with kPerRegister elements per register; value(bits, part) unpacks
// one element.
template <int kDepth, int kPerRegister, typename Value>
void multiply(const char* name, float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2], const Value& value) {
  constexpr int kQuad = 4 * kPerRegister;  // elements along k in one register of each of four lanes
  static_assert(kDepth == 2 * kQuad, "two registers along k");
  const Fragments mine = {{a[0], a[1], a[2], a[3]}, {b[0], b[1]}};
  const int lane = vn_emulation::lane();
  const unsigned char* slots = vn_emulation::meet(name, &mine, sizeof mine);
  float rows[2][kDepth], columns[2][kDepth];
  for (int k = 0; k < kDepth; ++k) {
    const int member = k % kQuad / kPerRegister, part = k % kPerRegister, side = k / kQuad;
    const auto left = vn_emulation::from_lane<Fragments>(slots, lane / 4 * 4 + member);
    for (int half = 0; half < 2; ++half) {
      const int column = 2 * (lane % 4) + half;
      const auto right = vn_emulation::from_lane<Fragments>(slots, column * 4 + member);
      rows[half][k] = value(left.a[half + 2 * side], part);
      columns[half][k] = value(right.b[side], part);
    }
  }
  for (int i = 0; i < 4; ++i) {
    double sum = d[i];
    for (int k = 0; k < kDepth; ++k) sum += static_cast<double>(rows[i / 2][k]) * columns[i % 2][k];
    d[i] = static_cast<float>(sum);
  }
}

}  // namespace

void emulated_multiply(Multiplied type, float (&d)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
  if (type == Multiplied::tf32) {
    return multiply<8, 1>("mma.m16n8k8", d, a, b, [](uint32_t bits, int) { return float_of(bits); });
  }
  if (type == Multiplied::bfloat16) {
    return multiply<16, 2>("mma.m16n8k16", d, a, b, [](uint32_t bits, int part) {
      return float_of(part == 0 ? bits << 16 : bits & 0xffff0000);
    });
  }
  static const std::vector<float> halves = all_halves();
  multiply<16, 2>("mma.m16n8k16", d, a, b,
                  [](uint32_t bits, int part) { return halves[bits >> (16 * part) & 0xffff]; });
}

}  // namespace voronerf
