#include "geometry/centre_grid.h"

#include <algorithm>

#include "bindings/bind.h"

namespace voronerf {

VN_OPAQUE(CentreGridTables);
VN_STRUCT(CentreGrid, frame, entries, lists, table, bits);

namespace {

int64_t centre_grid_entries(const CentreGridTables& tables) {
  return static_cast<int64_t>(tables.entries.size());
}
int64_t centre_grid_lists(const CentreGridTables& tables) {
  return static_cast<int64_t>(tables.lists.size());
}
// What a build has found, to the tensors that Python has made for it. False if the root grid has other bits.
bool centre_grid_copy(const CentreGridTables& tables, int bits, float* frame, int32_t* entries, int32_t* lists) {
  std::copy(tables.frame, tables.frame + 6, frame);
  std::copy(tables.entries.begin(), tables.entries.end(), entries);
  std::copy(tables.lists.begin(), tables.lists.end(), lists);
  return tables.bits == bits;
}

}  // namespace

VN_BINDINGS(module) {
  module.opaque<CentreGridTables>();
  module.cpu("centre_grid_build", VN_CPU(centre_grid_build));
  module.plain("centre_grid_entries", VN_CPU(centre_grid_entries));
  module.plain("centre_grid_lists", VN_CPU(centre_grid_lists));
  module.plain("centre_grid_copy", VN_CPU(centre_grid_copy));
  module.cpu("nearest_centre_grid", VN_CPU(nearest_centre_grid_cpu<float>));
  module.cpu("nearest_centre_grid", VN_CPU(nearest_centre_grid_cpu<double>));
}

}  // namespace voronerf
