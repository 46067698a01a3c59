// Makes an MlpPlan from a layer table and owns its arrays.
#pragma once

#include <vector>

#include "network/cpu/grouped_mlp_plan.h"
#include "network/grouped_mlp.h"

namespace voronerf {

struct MlpWanted {
  bool parameters, positions, directions, features;  // gradients; none: a forward pass
  bool half;                                         // bfloat16 operands
};

// Inputs whose rows are not where the tile's are.
struct MlpGathered {
  bool positions, directions;
};

class MlpPlanner {
 public:
  MlpPlanner(const MlpTable& table, const MlpGathered& gathered, const MlpWanted& wanted);
  MlpPlanner(const MlpPlanner&) = delete;
  MlpPlanner& operator=(const MlpPlanner&) = delete;
  const MlpPlan& plan() const { return plan_; }

 private:
  void mark_live(const MlpTable& table);
  void order_gradients();
  void place_buffers();

  MlpPlan plan_{};
  std::vector<MlpPlanLayer> layers_;
  std::vector<std::vector<MlpPlanSource>> sources_;
  std::vector<MlpPlanOutput> outputs_;
};

}  // namespace voronerf
