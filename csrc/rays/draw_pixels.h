// The pixels of a training step, drawn from runs of pixels: n runs, p known pixels, b pixels. What it computes is said
// in voronerf/ops/draw_pixels/reference.py.
#pragma once

#include <cstdint>

#include "common/hashed.h"
#include "common/row_count.h"

namespace voronerf {

struct DrawPixelsInputs {
  const int32_t* seed;   // [1]
  const int64_t* ends;   // [n], how many pixels the runs up to each have; or null, for all of 0 to below - 1
  const int64_t* shift;  // [n], added to a place in a run
  const int32_t* first;  // the first run that ends behind place 0, 2^bits, 2 * 2^bits, ...
  int64_t n, places;     // entries of ends and shift, and of first
  int64_t bits;
  int64_t below;  // places of all runs
  RowCount b;
  const int64_t* known;    // [p], which the first of all pixels are drawn from; or null
  const float* distances;  // [p], of these
  int64_t p;
  RowCount several;  // as many as are drawn from them
};

// The run of a place: looked for from the first that can hold it, within the tables whatever they say.
VN_HD int64_t first_run(const DrawPixelsInputs& in, int64_t place) {
  const int64_t at = place >> in.bits, run = in.first[at < in.places ? at : in.places - 1];
  return run < 0 ? 0 : run < in.n ? run : in.n - 1;
}
VN_HD int64_t run_of(const DrawPixelsInputs& in, int64_t run, int64_t place) {
  while (run + 1 < in.n && in.ends[run] <= place) ++run;
  return run;
}

// 48 bits of hashes as a place below a number.
VN_HD int64_t draw_place(uint32_t key, int64_t below) {
  const double fraction = static_cast<double>(hashed(key, 0)) + static_cast<double>(hashed(key, 1)) * 0x1p-24;
  return static_cast<int64_t>(fraction * static_cast<double>(below));
}

// pixels: [b]. uniforms: [b,3], in [0, 1). distances: [several].
void draw_pixels_cpu(const DrawPixelsInputs& in, int64_t* pixels, float* uniforms, float* distances, int threads);
void draw_pixels_cuda(const DrawPixelsInputs& in, int64_t* pixels, float* uniforms, float* distances, void* stream);

}  // namespace voronerf
