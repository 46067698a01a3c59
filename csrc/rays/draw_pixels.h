// Draws the b pixels of a training step from n runs of consecutive pixels, and from p pixels whose distance is known. A
// place is an index in the concatenation of all runs. The formulas are in voronerf/ops/draw_pixels/reference.py.
#pragma once

#include <cstdint>

#include "common/hashed.h"
#include "common/row_count.h"

namespace voronerf {

struct DrawPixelsInputs {
  const int32_t* seed;   // [1]
  const int64_t* ends;   // [n], running sums of the runs' lengths; or null: every pixel < `below`
  const int64_t* shift;  // [n], pixel minus place, for the places in each run
  const int32_t* first;  // the first runs that end behind places 0, 2^bits, 2 * 2^bits, ...; they speed up the search
  int64_t n, places;     // n: entries of ends and shift; places: entries of first
  int64_t bits;
  int64_t below;  // the number of places in all runs; without runs, of pixels
  RowCount b;
  const int64_t* known_pixels;  // [p], the known pixels, from which the first pixels are drawn; or null
  const float* distances;       // [p], the distances of the known pixels
  int64_t p;
  RowCount known_count;  // how many leading pixels are drawn from the known pixels
};

// `first_run` returns the first run that can hold a place; from this run on, `run_of` searches for the run of the
// place. Both functions stay within the tables, even if the tables' entries are invalid.
VN_HD int64_t first_run(const DrawPixelsInputs& in, int64_t place) {
  const int64_t at = place >> in.bits, run = in.first[at < in.places ? at : in.places - 1];
  return run < 0 ? 0 : run < in.n ? run : in.n - 1;
}
VN_HD int64_t run_of(const DrawPixelsInputs& in, int64_t run, int64_t place) {
  while (run + 1 < in.n && in.ends[run] <= place) ++run;
  return run;
}

// Returns a random place below `below`, from 48 bits of hashes.
VN_HD int64_t draw_place(uint32_t key, int64_t below) {
  const double fraction = static_cast<double>(hashed(key, 0)) + static_cast<double>(hashed(key, 1)) * 0x1p-24;
  return static_cast<int64_t>(fraction * static_cast<double>(below));
}

// pixels: [b]. uniforms: [b,3], in [0, 1). distances: [known_count], of the pixels drawn from the known pixels.
void draw_pixels_cpu(const DrawPixelsInputs& in, int64_t* pixels, float* uniforms, float* distances, int threads);
void draw_pixels_cuda(const DrawPixelsInputs& in, int64_t* pixels, float* uniforms, float* distances, void* stream);

}  // namespace voronerf
