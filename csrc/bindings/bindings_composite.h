// How voronerf/native/composite.py passes the arguments of composite, on the CPU and on CUDA.
#pragma once

#include <cstdint>
#include <vector>

#include "common/common.h"
#include "rays/composite.h"

// inputs: sigma, rgb, depths, deltas, offsets, background. sizes: r, s, m, c, whether the background is per ray.
inline voronerf::CompositeInputs composite_inputs(const std::vector<std::uintptr_t>& addresses,
                                                  const std::vector<int64_t>& sizes) {
  VN_CHECK(addresses.size() == 6 && sizes.size() == 5, "composite: arguments missing");
  const auto read = [&](size_t i) { return reinterpret_cast<const float*>(addresses[i]); };
  return {read(0),  read(1),  read(2),  read(3), reinterpret_cast<const int32_t*>(addresses[4]), read(5), sizes[4] != 0,
          sizes[0], sizes[1], sizes[2], sizes[3]};
}

// colour, opacity, depth, weights.
inline voronerf::CompositeOutputs composite_outputs(const std::vector<std::uintptr_t>& results) {
  VN_CHECK(results.size() == 4, "composite: results missing");
  const auto write = [&](size_t i) { return reinterpret_cast<float*>(results[i]); };
  return {write(0), write(1), write(2), write(3)};
}

// incoming: gradients of colour, opacity, depth and weights, 0 for zero. outgoing: where those of sigma, rgb, depths,
// deltas and background go, 0 where not wanted, and the workspace.
inline voronerf::CompositeGradients composite_gradients(const std::vector<std::uintptr_t>& incoming,
                                                        const std::vector<std::uintptr_t>& outgoing) {
  VN_CHECK(incoming.size() == 4 && outgoing.size() == 6, "composite: gradients missing");
  const auto read = [&](size_t i) { return reinterpret_cast<const float*>(incoming[i]); };
  const auto write = [&](size_t i) { return reinterpret_cast<float*>(outgoing[i]); };
  return {read(0), read(1), read(2), read(3), write(0), write(1), write(2), write(3), write(4), write(5)};
}
