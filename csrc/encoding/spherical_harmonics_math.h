// The real spherical harmonics of bands 0 to 3 as polynomials of a direction, with the order, signs and constants of
// tiny-cuda-nn.
#pragma once

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

struct SphericalHarmonics {
  static constexpr int kMost = 16;  // columns at degree 4

  template <typename X, typename Put>
  VN_INLINE void values(const X& of, int, int degree, const Put& put) {
    const F32 x = of(0), y = of(1), z = of(2);
    put(0, F32{} + 0.28209479177387814f);
    if (degree < 2) return;
    put(1, -0.48860251190291987f * y);
    put(2, 0.48860251190291987f * z);
    put(3, -0.48860251190291987f * x);
    if (degree < 3) return;
    const F32 xy = x * y, x2 = x * x, y2 = y * y, z2 = z * z;
    put(4, 1.0925484305920792f * xy);
    put(5, -1.0925484305920792f * y * z);
    put(6, 0.94617469575755997f * z2 - 0.31539156525251999f);
    put(7, -1.0925484305920792f * x * z);
    put(8, 0.54627421529603959f * (x2 - y2));
    if (degree < 4) return;
    put(9, 0.59004358992664352f * y * (y2 - 3.0f * x2));
    put(10, 2.8906114426405538f * xy * z);
    put(11, 0.45704579946446572f * y * (1.0f - 5.0f * z2));
    put(12, 0.3731763325901154f * z * (5.0f * z2 - 3.0f));
    put(13, 0.45704579946446572f * x * (1.0f - 5.0f * z2));
    put(14, 1.4453057213202769f * z * (x2 - y2));
    put(15, 0.59004358992664352f * x * (3.0f * y2 - x2));
  }

  template <typename X, typename G, typename Put>
  VN_INLINE void gradient(const X& of, int, int degree, const G& g, const Put& put) {
    const F32 x = of(0), y = of(1), z = of(2);
    F32 to_x{}, to_y{}, to_z{};
    if (degree > 1) {
      to_x = -0.48860251190291987f * g(3);
      to_y = -0.48860251190291987f * g(1);
      to_z = 0.48860251190291987f * g(2);
    }
    if (degree > 2) {
      to_x = to_x + 1.0925484305920792f * (y * g(4) - z * g(7) + x * g(8));
      to_y = to_y + 1.0925484305920792f * (x * g(4) - z * g(5) - y * g(8));
      to_z = to_z + 1.8923493915151199f * z * g(6) - 1.0925484305920792f * (y * g(5) + x * g(7));
    }
    if (degree > 3) {
      const F32 xy = x * y, xz = x * z, yz = y * z, difference = x * x - y * y, z2 = z * z;
      const F32 of_11 = 0.45704579946446572f * (1.0f - 5.0f * z2);
      to_x = to_x - 3.5402615395598611f * xy * g(9) + 2.8906114426405538f * yz * g(10) + of_11 * g(13) +
             2.8906114426405538f * xz * g(14) - 1.7701307697799306f * difference * g(15);
      to_y = to_y - 1.7701307697799306f * difference * g(9) + 2.8906114426405538f * xz * g(10) + of_11 * g(11) -
             2.8906114426405538f * yz * g(14) + 3.5402615395598611f * xy * g(15);
      to_z = to_z + 2.8906114426405538f * xy * g(10) - 4.5704579946446572f * (yz * g(11) + xz * g(13)) +
             1.1195289977703462f * (5.0f * z2 - 1.0f) * g(12) + 1.4453057213202769f * difference * g(14);
    }
    put(0, to_x);
    put(1, to_y);
    put(2, to_z);
  }
};

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
