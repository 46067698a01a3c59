// Random inputs and result checks of the C++ tests.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <type_traits>
#include <vector>

template <typename T>
using Array = std::vector<T>;

inline std::mt19937 generator(0);
inline bool wild = false;  // whether inputs have NaN and infinity

inline int64_t below(int64_t n) {
  return static_cast<int64_t>(generator() % static_cast<uint32_t>(n));
}

template <typename T>
Array<T> uniform(int64_t size) {
  Array<T> values(size);
  for (T& value : values) {
    value = static_cast<T>(generator()) / static_cast<T>(4294967296.0) * 2 - 1;
    if (wild && below(9) == 0) {
      const T odd[] = {std::numeric_limits<T>::quiet_NaN(), std::numeric_limits<T>::infinity(),
                       -std::numeric_limits<T>::infinity(), std::numeric_limits<T>::max(),
                       std::numeric_limits<T>::denorm_min()};
      value = odd[below(5)];
    }
  }
  return values;
}

// Draws values from a coarse lattice, so that there are ties.
template <typename T>
Array<T> lattice(int64_t size) {
  Array<T> values(size);
  for (T& value : values) value = static_cast<T>(below(7) - 3) / 2;
  return values;
}

// Returns NaN in heap memory of exactly this size, so that AddressSanitizer guards its ends.
inline Array<float> poisoned(int64_t size) {
  return Array<float>(size, std::nanf(""));
}

inline void fail(const std::string& what) {
  std::fprintf(stderr, "%s\n", what.c_str());
  std::exit(1);
}

template <typename T>
void same(const Array<T>& a, const Array<T>& b, const char* what) {
  if (a.size() != b.size() || (!a.empty() && std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) != 0)) {
    fail(std::string(what) + ": results depend on the number of threads");
  }
}

// Results of the portable path in a case. The other instruction sets repeat its calls on the same random numbers.
// Integers must be equal. For floats, the norm of the difference must be small. Single floats may differ more, since
// rounding may switch a ReLU unit.
inline std::vector<Array<double>> portable;
inline size_t compared = 0;

inline void start_case(int number, bool is_portable) {
  generator.seed(static_cast<uint32_t>(number));
  if (is_portable) portable.clear();
  compared = 0;
}

template <typename T>
void like_portable(const Array<T>& found, const char* what, double tolerance = 1e-5) {
  if (compared == portable.size()) portable.emplace_back(found.begin(), found.end());
  const Array<double>& expected = portable[compared++];
  if (found.size() != expected.size()) fail(std::string(what) + ": instruction sets differ in size");
  double difference = 0, size = 0;
  for (size_t i = 0; i < found.size(); ++i) {
    difference += (found[i] - expected[i]) * (found[i] - expected[i]);
    size += expected[i] * expected[i];
  }
  if (tolerance > 0.1 && size == 0) return;  // rounding may activate a ReLU that is off in all rows
  const double most = std::is_integral_v<T> ? 0 : tolerance * (std::sqrt(size) + 1e-3);
  if (!wild && !(std::sqrt(difference) <= most)) {
    fail(std::string(what) + ": differs from the portable path by " + std::to_string(std::sqrt(difference)) + " of " +
         std::to_string(std::sqrt(size)));
  }
}

inline void within(const Array<int32_t>& cells, int64_t k, const char* what) {
  for (const int32_t cell : cells) {
    if (cell < 0 || cell >= k) fail(std::string(what) + ": cell " + std::to_string(cell) + " of " + std::to_string(k));
  }
}

inline int64_t some_rows() {
  const int64_t sizes[] = {0, 1, below(20), 15 + below(4), 32 * below(9) + below(3), 2047 + below(4), below(9000)};
  return sizes[below(7)];
}

template <typename T>
const T* or_null(const Array<T>& array) {
  return array.empty() ? nullptr : array.data();
}
