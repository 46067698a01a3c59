#include "geometry/nearest_centre.h"

#include "bindings/bind.h"

namespace voronerf {

VN_BINDINGS(module) {
  module.cpu("nearest_centre", VN_CPU(nearest_centre_cpu<float>));
  module.cpu("nearest_centre", VN_CPU(nearest_centre_cpu<double>));
  module.cuda("nearest_centre", VN_CUDA(nearest_centre_cuda<float>));
  module.cuda("nearest_centre", VN_CUDA(nearest_centre_cuda<double>));
  // These functions take no Cpu or Cuda argument, so a recording does not replay them.
  module.plain("index_centres", &index_centres_cpu<float>);
  module.plain("index_centres", &index_centres_cpu<double>);
  module.plain("centre_index_words", &centre_index_words);
}

}  // namespace voronerf
