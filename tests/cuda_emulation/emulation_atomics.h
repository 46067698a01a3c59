// CUDA's atomic operations for emulation.h. They return the old value. They are real atomics, so that sanitizers, which
// treat fibers as threads, see no race.
#pragma once

#include <algorithm>

template <typename T, typename Change>
T vn_change_atomically(T* to, const Change& change) {
  T before, after;
  __atomic_load(to, &before, __ATOMIC_RELAXED);
  do {
    after = change(before);
  } while (!__atomic_compare_exchange(to, &before, &after, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
  return before;
}

inline float atomicAdd(float* to, float value) {
  return vn_change_atomically(to, [&](float before) { return before + value; });
}
inline int atomicMax(int* to, int value) {
  return vn_change_atomically(to, [&](int before) { return std::max(before, value); });
}
inline unsigned atomicMin(unsigned* to, unsigned value) {
  return vn_change_atomically(to, [&](unsigned before) { return std::min(before, value); });
}
inline float atomicExch(float* to, float value) {
  return vn_change_atomically(to, [&](float) { return value; });
}
inline unsigned atomicOr(unsigned* to, unsigned value) {
  return vn_change_atomically(to, [&](unsigned before) { return before | value; });
}
