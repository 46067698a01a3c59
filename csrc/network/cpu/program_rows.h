// A program for rows that come a few at a time, to a thread of the caller's: what depends on the program and its
// parameters alone is made once.
#pragma once

#include <memory>
#include <vector>

#include "network/cpu/program_isa.h"
#include "network/program.h"

namespace voronerf {

class ProgramRows {
 public:
  // What a thread keeps from one call to the next.
  struct Own {
    float* memory;        // `workspace` floats, on a cache line
    int64_t packed = -1;  // the cell whose parameters lie there
  };

  // Of `in` the parameters, and which inputs are turned.
  ProgramRows(const Program& program, const ProgramInputs& in, Isa isa);

  int64_t workspace() const;  // floats of a thread, a multiple of 16

  // All rows of `in`, with the same parameters, on the calling thread. Nothing is kept, summed by ray or added to sums.
  void forward(const ProgramInputs& in, const ProgramResults& results, Own& own) const;

  // Parts of both
  // ------------------------------------------------------------------------------------------------------

  // What tiles read of a call, but for its memories. The arrays of this object and of `in` are to live as long.
  ProgramCall call(const ProgramInputs& in, const ProgramResults& results, bool* in_place) const;
  void pack(const ProgramCall& call, int64_t cell, bool first, float* own) const;
  void run(const ProgramCall& call, int64_t cell, int64_t begin, int64_t end, float* own, float* partial) const;
  void reduce(const ProgramCall& call, int64_t cell, float* partials, int64_t count) const;
  const std::vector<HashEncoding>& grids() const { return grids_; }

 private:
  const ProgramTable& table_;
  const Isa isa_;
  int64_t tile_;
  std::vector<int32_t> input_widths_, output_widths_;
  std::unique_ptr<bool[]> rays_, turned_;
  std::vector<HashEncoding> grids_;
};

}  // namespace voronerf
