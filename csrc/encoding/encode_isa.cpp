// The CPU kernels of the encodings, compiled once per instruction set.
//
// A tile is encoded directly into the result if its rows are whole vectors, else into a buffer in cache that is then
// copied. The backward pass recomputes sines and cosines, which are each other's derivatives: this costs less than
// reading back the encoding, which is twenty times as large as the input.
#define VN_HALF 0
#include "encoding/by_row_tile.h"
#include "encoding/encode.h"
#include "encoding/frequency_encode_tile.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// The current rows, and the thread's workspace.
struct Tile {
  const Encoding& in;
  const int64_t stride;  // of encoded rows in the workspace
  float *const table, *const encoded, *const staged, *const staged_variances;
  const float *x, *variances;  // [rows][d]
  int64_t rows;
  bool by_row = false;  // whether the kernel is ByRow
  bool in_place;        // read x and gradients without staging: enough rows follow for vectors to overrun

  Tile(const Encoding& in, float* workspace, int64_t stride)
      : in(in),
        stride(stride),
        table(workspace),
        encoded(table + 3 * stride),
        staged(encoded + kEncodeRows * stride),
        staged_variances(staged + kEncodeRows * in.d + kEncodeLanes) {}

  Columns columns() const { return {in.d, in.size, in.include_input}; }

  void take(int64_t first, int64_t end) {
    rows = smaller(end - first, kEncodeRows);
    in_place = by_row && in.n - first >= kEncodeRows + kEncodeLanes;
    x = in.x + first * in.d;
    variances = in.variances == nullptr ? nullptr : in.variances + first * in.d;
    if (in_place) return;
    stage(x, staged);
    if (variances != nullptr) stage(variances, staged_variances);
  }
  void stage(const float*& from, float* to) const {
    __builtin_memcpy(to, from, sizeof(float) * rows * in.d);
    __builtin_memset(to + rows * in.d, 0, sizeof(float) * ((kEncodeRows - rows) * in.d + kEncodeLanes));
    from = to;
  }

  // Calls run(kernel) with the kernel of the encoding.
  template <typename Run>
  void with_kernel(const Run& run) const {
    switch (in.encoding) {
#define VN_CASE(NAME, ...)    \
  case ProgramEncoding::NAME: \
    return run(__VA_ARGS__());
      VN_ENCODINGS(VN_CASE)
#undef VN_CASE
      case ProgramEncoding::hash:
        return;
    }
  }

  // Prepares data that a kernel shares between all rows.
  template <typename Formula>
  void prepare(ByRow<Formula>) {
    by_row = true;
  }
  template <bool kBlurred>
  void prepare(Octaves<kBlurred>) {
    encode_table(table, stride, columns());
  }

  // Writes encodings to rows of `stride` floats. Formulas are inlined for d = 3, so that their strides are constants.
  template <typename Formula>
  __attribute__((flatten)) void values(ByRow<Formula>, float* out) const {
    if (in.d == 3) return ByRow<Formula>::values(x, 3, 3, in.size, rows, out, stride);
    ByRow<Formula>::values(x, in.d, in.d, in.size, rows, out, stride);
  }
  template <bool kBlurred>
  void values(Octaves<kBlurred>, float* out) const {
    encode(x, in.d, table, rows, columns(), out, stride);
    if (kBlurred) blur(variances, in.d, in.d, table, rows, out, stride);
  }

  // Turns gradients g [rows][width] into gradients of x and of the variances, [rows][d].
  template <typename Formula>
  __attribute__((flatten)) void gradient(ByRow<Formula>, const float* g, float* of_x, float*) const {
    int64_t g_stride = in.width;
    if (!in_place) {
      for (int64_t row = 0; row < rows; ++row) copy_row(g + row * g_stride, g_stride, encoded + row * stride);
      g = encoded, g_stride = stride;
    }
    if (in.d == 3) return ByRow<Formula>::gradient(x, 3, 3, in.size, g, g_stride, rows, of_x, 3);
    ByRow<Formula>::gradient(x, in.d, in.d, in.size, g, g_stride, rows, of_x, in.d);
  }
  template <bool kBlurred>
  void gradient(Octaves<kBlurred> kernel, const float* g, float* of_x, float* of_variances) const {
    values(kernel, encoded);
    for (int64_t row = 0; row < rows; ++row, g += in.width) {
      const float* const value = encoded + row * stride;
      if (of_x != nullptr) encode_row_backward(value, g, table, stride, columns(), of_x + row * in.d);
      if (kBlurred && of_variances != nullptr) {
        blur_row_backward(value, g, table, stride, columns(), of_variances + row * in.d);
      }
    }
  }
};

}  // namespace

void encode_rows(const Encoding& in, float* out, float* workspace, int64_t stride, int64_t begin, int64_t end) {
  Tile tile(in, workspace, stride);
  tile.with_kernel([&, width = int64_t{in.width}](auto kernel) {
    tile.prepare(kernel);
    for (int64_t first = begin; first < end; first += kEncodeRows) {
      tile.take(first, end);
      float* const to = out + first * width;
      const bool direct = width == stride && tile.rows == kEncodeRows;
      tile.values(kernel, direct ? to : tile.encoded);
      if (direct) continue;
      const float* const encoded = tile.encoded;
      for (int64_t row = 0, rows = tile.rows; row < rows; ++row)
        copy_row(encoded + row * stride, width, to + row * width);
    }
  });
}

void encode_rows_backward(const Encoding& in, const float* gradient, float* grad_x, float* grad_variances,
                          float* workspace, int64_t stride, int64_t begin, int64_t end) {
  Tile tile(in, workspace, stride);
  tile.with_kernel([&](auto kernel) {
    tile.prepare(kernel);
    for (int64_t first = begin; first < end; first += kEncodeRows) {
      tile.take(first, end);
      const auto rows = [&](float* of) { return of == nullptr ? nullptr : of + first * in.d; };
      tile.gradient(kernel, gradient + first * in.width, rows(grad_x), rows(grad_variances));
    }
  });
}

}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
