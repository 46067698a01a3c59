// What torch says of a tensor in one call of 50 ns, where its methods take a microsecond: the exchange of DLPack, whose
// structs these are (https://dmlc.github.io/dlpack/latest/c_api.html). torch has it from 2.10 on.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

#include "bindings/load.h"

namespace voronerf {

struct TensorView {
  void* data = nullptr;
  int32_t device_type = 0, device_index = 0;
  int32_t dimensions = 0;
  uint8_t code = 0, bits = 0;
  uint16_t lanes = 0;
  const int64_t *shape = nullptr, *strides = nullptr;
  uint64_t byte_offset = 0;

  // False where torch does not say: no tensor of a plain class, or one without strides, without memory, or of a
  // transform. Then the methods of Python tell.
  bool look(_object* tensor);

  bool is_there() const { return device_type != 0; }
  bool on_cpu() const { return device_type == 1; }
  bool on_cuda() const { return device_type == 2; }
  unsigned dtype() const {
    switch (code << 8 | bits) {
      case 2 << 8 | 16:
        return kFloat16;
      case 4 << 8 | 16:
        return kBfloat16;
      case 2 << 8 | 32:
        return kFloat32;
      case 2 << 8 | 64:
        return kFloat64;
      case 0 << 8 | 32:
        return kInt32;
      case 0 << 8 | 64:
        return kInt64;
      case 1 << 8 | 8:
        return kUint8;
      case 6 << 8 | 8:
        return kBool;
      default:
        return kOther;
    }
  }
  int64_t entries() const {
    int64_t count = 1;
    for (int i = 0; i < dimensions; ++i) count *= shape[i];
    return count;
  }
  bool is_contiguous() const {
    int64_t size = 1;
    bool rising = true;
    for (int i = dimensions - 1; i >= 0; --i) {
      rising = rising && (shape[i] == 1 || strides[i] == size);
      size *= shape[i];
    }
    return rising || size == 0;
  }
  // Of its first entry; not null where it has none.
  void* address() const { return data == nullptr ? nothing() : static_cast<char*>(data) + byte_offset; }
  static void* nothing() {
    alignas(64) static char memory[64];
    return memory;
  }
};

// That memory holds the values negated, as of x.conj().imag.
bool is_negative(_object* tensor);

// Has the classes of plain tensors, and the capsule of torch's exchange, or None.
void know_tensors(_object* classes, _object* exchange);

}  // namespace voronerf
