// Functions about the processor and its memory, which belong to no op.
#include <cstring>

#include "bindings/bind.h"
#include "common/huge_pages.h"
#include "common/isa.h"
#include "common/measure_peak.h"
#include "common/parallel.h"
#include "common/row_count.h"

namespace voronerf {

VN_NAMES(Peak, "float32", "bfloat16", "copy");

// Fills the rows of a recorded step's memory [rows,columns] with zeros.
void zero_rows(float* memory, int64_t columns, RowCount rows, int threads) {
  parallel_blocks(rows * columns, 1 << 14, threads,
                  [&](int64_t begin, int64_t end) { std::memset(memory + begin, 0, sizeof(float) * (end - begin)); });
}

VN_BINDINGS(module) {
  module.plain("isa_supported", VN_CPU(isa_supported));
  module.cpu("measure_peak", VN_CPU(measure_peak));
  module.plain("bfloat16_gain", VN_CPU(bfloat16_gain));
  module.cpu("zero_rows", VN_CPU(zero_rows));
  module.plain("advise_huge_pages", VN_CPU(advise_huge_pages));
}

}  // namespace voronerf
