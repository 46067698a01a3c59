// The CPU kernels of the spherical harmonics, once for each instruction set: tiles of rows, read and written where they
// are if they are whole and 16 wide, else by way of the cache.
#include "encoding/spherical_harmonics.h"
#include "encoding/spherical_harmonics_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

constexpr int64_t kRows = 64;

struct Staged {
  float directions[3 * kRows] = {}, values[kMostHarmonics * kRows] = {};
};

}  // namespace

void harmonics_rows(const float* directions, float* out, int64_t n, int64_t degree) {
  Staged staged;
  const int64_t width = degree * degree;
  for (int64_t first = 0; first < n; first += kRows, directions += 3 * kRows, out += width * kRows) {
    const int64_t rows = n - first < kRows ? n - first : kRows;
    if (rows == kRows && width == kMostHarmonics) {
      harmonics_of_rows(directions, rows, degree, out, width);
      continue;
    }
    __builtin_memcpy(staged.directions, directions, sizeof(float) * 3 * rows);
    harmonics_of_rows(staged.directions, rows, degree, staged.values, kMostHarmonics);
    for (int64_t row = 0; row < rows; ++row) {
      for (int64_t c = 0; c < width; ++c) out[row * width + c] = staged.values[row * kMostHarmonics + c];
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
    if (rows < kRows || width < kMostHarmonics) {
      __builtin_memcpy(staged.directions, x, sizeof(float) * 3 * rows);
      for (int64_t row = 0; row < rows; ++row) {
        for (int64_t c = 0; c < width; ++c) staged.values[row * kMostHarmonics + c] = g[row * width + c];
      }
      x = staged.directions;
      g = staged.values;
    }
    harmonics_of_rows_backward(x, g, kMostHarmonics, rows, degree, grad_directions + 3 * first);
  }
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
