// The CPU kernels of the spherical harmonics, once for each instruction set: tiles of rows, read and written where they
// are if they are whole and 16 wide, else by way of the cache.
#define VN_HALF 0
#include "encoding/by_row_tile.h"
#include "encoding/spherical_harmonics.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

using Harmonics = ByRow<SphericalHarmonics>;
constexpr int64_t kRows = 64, kMost = SphericalHarmonics::kMost;

struct Staged {
  float directions[3 * kRows] = {}, values[kMost * kRows] = {};
};

}  // namespace

void harmonics_rows(const float* directions, float* out, int64_t n, int64_t degree) {
  Staged staged;
  const int64_t width = degree * degree;
  for (int64_t first = 0; first < n; first += kRows, directions += 3 * kRows, out += width * kRows) {
    const int64_t rows = n - first < kRows ? n - first : kRows;
    if (rows == kRows && width == kMost) {
      Harmonics::values(directions, 3, 3, degree, rows, out, width);
      continue;
    }
    __builtin_memcpy(staged.directions, directions, sizeof(float) * 3 * rows);
    Harmonics::values(staged.directions, 3, 3, degree, rows, staged.values, kMost);
    for (int64_t row = 0; row < rows; ++row) {
      for (int64_t c = 0; c < width; ++c) out[row * width + c] = staged.values[row * kMost + c];
    }
  }
}

void harmonics_rows_backward(const float* directions, const float* gradient, float* grad_directions, int64_t n,
                             int64_t degree) {
  Staged staged;
  const int64_t width = degree * degree;
  for (int64_t first = 0; first < n; first += kRows) {
    const int64_t rows = n - first < kRows ? n - first : kRows;
    const float *x = directions + 3 * first, *g = gradient + width * first;
    if (rows < kRows || width < kMost) {
      __builtin_memcpy(staged.directions, x, sizeof(float) * 3 * rows);
      for (int64_t row = 0; row < rows; ++row) {
        for (int64_t c = 0; c < width; ++c) staged.values[row * kMost + c] = g[row * width + c];
      }
      x = staged.directions;
      g = staged.values;
    }
    Harmonics::gradient(x, 3, 3, degree, g, kMost, rows, grad_directions + 3 * first, 3);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
