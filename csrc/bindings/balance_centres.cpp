#include "geometry/balance_centres.h"

#include "bindings/bind.h"

namespace voronerf {

VN_STRUCT(BalanceInputs, samples, masses, m, k, steps, alpha, neighbours);

VN_BINDINGS(module) {
  module.cpu("balance_centres", VN_CPU(balance_centres_cpu));
  module.plain("balance_centres_workspace", VN_CPU(balance_centres_workspace));
}

}  // namespace voronerf
