#pragma once

#include <cstdint>

constexpr int kGroupSteps = 8;  // at most

struct GroupProductCase {
  const uint16_t* a;            // [64 groups][16 steps]
  const unsigned char* packed;  // [bytes]
  float* out;                   // [64 groups][8 tiles]
  int bytes, steps, step_bytes;
  uint32_t leading, stride;
  int bug;
};

void group_product(const GroupProductCase& given, int threads, int tiles, bool bfloat16);
