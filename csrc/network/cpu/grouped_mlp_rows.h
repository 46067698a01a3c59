// The networks of grouped_mlp for rows that come a few at a time, to a thread of the caller's: what depends on the
// layer table alone is made once.
#pragma once

#include "encoding/hash_encode_math.h"
#include "network/cpu/grouped_mlp_planner.h"

namespace voronerf {

class MlpRows {
 public:
  // What a thread keeps from one call to the next.
  struct Own {
    float* memory;        // `workspace` floats, on a cache line
    int64_t packed = -1;  // the cell whose weights lie there
  };

  // Of `in` the features.
  MlpRows(const MlpTable& table, const MlpInputs& in, const MlpGathered& gathered, Isa isa);

  int64_t workspace() const;  // floats of a thread

  // Rows of `in`, which has the same features, on the calling thread.
  void forward(const MlpInputs& in, float* out, Own& own) const;

 private:
  const MlpPlanner planner_;
  const HashEncoding hash_;
  const Isa isa_;
};

}  // namespace voronerf
