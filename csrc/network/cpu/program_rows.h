// A program for calls that have few rows each and run on the caller's threads. Data that depends only on the program
// and its parameters is prepared once.
#pragma once

#include <memory>
#include <vector>

#include "network/cpu/program_isa.h"
#include "network/program.h"

namespace voronerf {

class ProgramRows {
 public:
  // The state of a thread between calls.
  struct WorkerMemory {
    float* memory;        // workspace() floats, aligned to a cache line
    int64_t packed = -1;  // the cell whose parameters are packed; -1: none
  };

  // Prepares a program, and reads only the member `transposed` of `in`.
  ProgramRows(const Program& program, const ProgramInputs& in, Isa isa);

  int64_t workspace() const;  // floats per thread, a multiple of 16

  // Runs all rows of `in` on the calling thread, with the same parameters in every call. It supports neither look-ups
  // whose results the caller keeps, nor outputs per ray, nor sums.
  void forward(const ProgramInputs& in, const ProgramResults& results, WorkerMemory& own) const;

  // Steps shared with grouped_program_cpu
  // ------------------------------------------------------------------------------------------------------

  // Returns the data of a call except its arrays of n rows (`memories`, `filled` and `looked_up`). The data points into
  // this object, `in` and `results`, which must outlive the data.
  CpuProgram call(const ProgramInputs& in, const ProgramResults& results, bool* in_place) const;
  void pack(const CpuProgram& call, int64_t cell, bool first, float* own) const;
  void run(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, float* own, float* partial) const;
  void reduce(const CpuProgram& call, int64_t cell, float* partials, int64_t count) const;
  const std::vector<HashEncoding>& grids() const { return grids_; }

 private:
  const ProgramTable& table_;
  const Isa isa_;
  int64_t tile_;
  std::vector<int32_t> input_widths_, output_widths_;
  std::unique_ptr<bool[]> rays_, transposed_;
  std::vector<HashEncoding> grids_;
};

}  // namespace voronerf
