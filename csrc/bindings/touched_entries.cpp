#include "encoding/touched_entries.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("pack_touched", VN_CPU(pack_touched_cpu));
  module.cpu("add_touched", VN_CPU(add_touched_cpu));
}

}  // namespace voronerf
