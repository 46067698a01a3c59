// Functions about the processor and its memory, which belong to no op.
#include "bindings/bind.h"
#include "common/huge_pages.h"
#include "common/isa.h"
#include "common/measure_peak.h"

namespace voronerf {

VN_NAMES(Peak, "float32", "bfloat16", "copy");

VN_BINDINGS(module) {
  module.plain("isa_supported", VN_CPU(isa_supported));
  module.cpu("measure_peak", VN_CPU(measure_peak));
  module.plain("bfloat16_gain", VN_CPU(bfloat16_gain));
  module.plain("advise_huge_pages", VN_CPU(advise_huge_pages));
}

}  // namespace voronerf
