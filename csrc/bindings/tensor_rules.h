// The rules for the tensors of a call, from voronerf/ops/_core/checks.py and the signatures of declare.py.
#pragma once

#include <algorithm>
#include <map>
#include <string>
#include <vector>

#include "bindings/questions.h"

namespace voronerf {

constexpr int kMostLetters = 32;
constexpr int64_t kMostRows = (int64_t{1} << 31) - 1, kMostGroups = int64_t{1} << 27;  // checks.MAX_COUNT, MAX_GROUPS

inline unsigned dtypes_of(const py::handle& names) {
  static const std::map<std::string, unsigned> masks = {
      {"float16", kFloat16}, {"bfloat16", kBfloat16}, {"float32", kFloat32}, {"float64", kFloat64},
      {"int32", kInt32},     {"int64", kInt64},       {"uint8", kUint8},     {"bool", kBool}};
  unsigned bits = 0;
  for (const auto& name : names) {
    const auto entry = masks.find(py::cast<std::string>(name));
    if (entry != masks.end()) bits |= entry->second;  // other dtypes fail the check, and Python raises the error
  }
  return bits;
}

// Numbers the letters of shapes, such as n in [n, 3], in the order of their first use.
class Letters {
 public:
  // An entry of a shape: a number (`more`), or the value of a letter plus `more`. With or_one it may also be 1.
  struct Size {
    int letter = -1;
    int64_t more = 0;
    bool or_one = false;
  };

  int number(const std::string& name) {
    const auto [entry, is_new] = names_.emplace(name, static_cast<int>(names_.size()));
    if (is_new && entry->second >= kMostLetters) throw std::invalid_argument("too many letters of shapes");
    return entry->second;
  }
  std::vector<Size> sizes(const py::handle& shape) {
    std::vector<Size> result;
    for (const auto& entry : shape) {
      if (py::isinstance<py::int_>(entry)) {
        result.push_back({-1, py::cast<int64_t>(entry)});
        continue;
      }
      auto text = py::cast<std::string>(entry);
      const bool or_one = text.compare(0, 2, "1|") == 0;
      if (or_one) text.erase(0, 2);
      const size_t end = text.find("+1");
      result.push_back({number(text.substr(0, end)), end == std::string::npos ? 0 : 1, or_one});
    }
    return result;
  }

 private:
  std::map<std::string, int> names_;
};

// The values that all tensors of a call share: letters, dtype and device. Each checked tensor may add values.
struct Common {
  int64_t letters[kMostLetters] = {};
  uint32_t bound = 0;
  unsigned first_float = 0;
  int32_t device_type = -1, device_index = 0;
  bool learns = false;  // whether a tensor requires a gradient

  bool bind(int letter, int64_t value) {
    if ((bound >> letter & 1) != 0) return letters[letter] == value;
    bound |= 1u << letter;
    letters[letter] = value;
    return true;
  }
  int64_t size(const Letters::Size& size) const {
    return size.letter < 0 ? size.more : letters[size.letter] + size.more;
  }
};

// The rule for one tensor, as in Checked.tensor of checks.py.
struct TensorRule {
  unsigned dtypes = 0;
  // same: the dtype of the first floating-point tensor; wide: the same dtype, but at least float32
  bool same = false, wide = false;
  bool either = false;  // the tensor may have either of the two shapes
  bool filled = false;  // the letter of the first size is at least 1
  std::vector<Letters::Size> shape, otherwise;

  // Reads a tuple (dtypes, kind, shape, second shape or None); the kind is "same", "wide", "filled" or "".
  static TensorRule of(const py::handle& row, Letters& letters) {
    const auto parts = py::cast<py::tuple>(row);
    const auto kind = py::cast<std::string>(parts[1]);
    TensorRule rule;
    rule.dtypes = dtypes_of(parts[0]);
    rule.same = kind == "same";
    rule.wide = kind == "wide";
    rule.filled = kind == "filled";
    rule.shape = letters.sizes(parts[2]);
    if (!parts[3].is_none()) rule.otherwise = letters.sizes(parts[3]);
    return rule;
  }
  bool fits(const TensorView& view, bool second, Common& common) const {
    const auto& sizes = second || (either && view.dimensions != static_cast<int>(shape.size())) ? otherwise : shape;
    if (view.dimensions != static_cast<int>(sizes.size())) return false;
    for (int i = 0; i < view.dimensions; ++i) {
      const Letters::Size& size = sizes[static_cast<size_t>(i)];
      const int64_t actual = view.shape[i];
      if (size.or_one && actual == 1) continue;
      if (size.letter < 0 ? actual != size.more : !common.bind(size.letter, actual - size.more)) return false;
      if (size.letter >= 0 && size.more == 1 && (actual < 1 || actual > kMostGroups + 1)) return false;
    }
    if (view.dimensions > 0 && view.shape[0] > kMostRows) return false;
    if (filled && view.shape[0] <= sizes[0].more) return false;
    const unsigned dtype = view.dtype(), first = common.first_float;
    if (same || wide) {
      if (first == 0 || dtype != (wide && first != kFloat64 ? kFloat32 : first)) return false;
    } else if ((dtype & dtypes) == 0) {
      return false;
    }
    if (first == 0 && (dtype & kFloating) != 0) common.first_float = dtype;
    if (common.device_type < 0) {
      common.device_type = view.device_type;
      common.device_index = view.device_index;
    }
    return common.device_type == view.device_type && common.device_index == view.device_index;
  }
};

// The rules for a list of tensors that are not separate arguments, such as the tensors of a network.
class TensorRules {
 public:
  // Reads the rows of checks.py. A tuple for TensorRule::of is the rule of a tensor; a tuple (letter, number) gives the
  // default of a letter that is still unbound. `names` are the letters whose values a check returns.
  TensorRules(const py::sequence& rows, const std::vector<std::string>& names) {
    for (const auto& row : rows) {
      const auto parts = py::cast<py::tuple>(row);
      if (parts.size() == 2) {
        rules_.emplace_back();
        defaults_.push_back({letters_.number(py::cast<std::string>(parts[0])), py::cast<int64_t>(parts[1])});
      } else {
        rules_.push_back(TensorRule::of(row, letters_));
        defaults_.emplace_back();
      }
    }
    for (const std::string& name : names) asked_.push_back(letters_.number(name));
  }
  // Returns the values of the letters (0: unbound); None if a tensor breaks a rule, or if the rules cannot be checked
  // here.
  py::object check(const py::list& tensors) const {
    Common common;
    Py_ssize_t i = 0;
    for (size_t row = 0; row < rules_.size(); ++row) {
      const Letters::Size& fallback = defaults_[row];
      if (fallback.letter >= 0) {
        if ((common.bound >> fallback.letter & 1) == 0) common.bind(fallback.letter, fallback.more);
        continue;
      }
      if (i == PyList_GET_SIZE(tensors.ptr())) return py::none();
      PyObject* const tensor = PyList_GET_ITEM(tensors.ptr(), i++);
      TensorView view;
      if (!view.look(tensor) || !rules_[row].fits(view, false, common)) return py::none();
      common.learns = common.learns || ((view.dtype() & kFloating) != 0 && requires_gradient(tensor));
    }
    if (i != PyList_GET_SIZE(tensors.ptr())) return py::none();
    if (common.learns && questions.grad()) {
      for (const auto& tensor : tensors) {
        if (is_inference(tensor.ptr())) return py::none();
      }
    }
    py::tuple result(asked_.size());
    for (size_t each = 0; each < asked_.size(); ++each) result[each] = py::int_(common.letters[asked_[each]]);
    return std::move(result);
  }

 private:
  Letters letters_;
  std::vector<TensorRule> rules_;
  std::vector<Letters::Size> defaults_;  // of rows (letter, number)
  std::vector<int> asked_;
};

// Returns whether the lists have equally many tensors, with equal shapes at each place. All tensors must be float32 and
// on one device, tensors in lists marked in `written` must be contiguous, and the scalars must be tensors [].
inline bool alike(const py::sequence& lists, const std::vector<bool>& written, const py::list& scalars) {
  std::vector<TensorView> first;
  for (size_t i = 0; i < lists.size(); ++i) {
    const py::object list = lists[i];
    if (!PyList_Check(list.ptr()) && !PyTuple_Check(list.ptr())) return false;
    const auto count = static_cast<size_t>(PySequence_Fast_GET_SIZE(list.ptr()));
    if (i == 0) first.resize(count);
    if (count != first.size()) return false;
    for (size_t j = 0; j < count; ++j) {
      PyObject* const tensor = PySequence_Fast_GET_ITEM(list.ptr(), static_cast<Py_ssize_t>(j));
      TensorView view;
      if (!view.look(tensor) || view.dtype() != kFloat32) return false;
      if (i == 0) first[j] = view;
      const TensorView& expected = first[j];
      if (view.dimensions != expected.dimensions ||
          !std::equal(view.shape, view.shape + view.dimensions, expected.shape)) {
        return false;
      }
      if (view.device_type != first[0].device_type || view.device_index != first[0].device_index) return false;
      if (written.at(i) && (!view.is_contiguous() || is_negative(tensor))) return false;
    }
  }
  return !first.empty() && std::all_of(scalars.begin(), scalars.end(), [&first](const py::handle& scalar) {
    TensorView view;
    return view.look(scalar.ptr()) && view.dimensions == 0 && view.dtype() == kFloat32 && !is_negative(scalar.ptr()) &&
           view.device_type == first[0].device_type && view.device_index == first[0].device_index;
  });
}

}  // namespace voronerf
