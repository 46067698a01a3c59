// The rules for the tensors of a call, from voronerf/ops/_core/checks.py and the signatures of declare.py.
#pragma once

#include <algorithm>
#include <list>
#include <map>
#include <string>
#include <vector>

#include "bindings/questions.h"

namespace voronerf {

constexpr int kMostLetters = 32;
constexpr int64_t kMostRows = (int64_t{1} << 31) - 1, kMostGroups = int64_t{1} << 27;  // checks.MAX_COUNT, MAX_GROUPS

// The dtypes of rules, in the order in which errors list them.
inline const std::vector<std::pair<std::string, unsigned>>& masks() {
  static const std::vector<std::pair<std::string, unsigned>> all = {
      {"float16", kFloat16}, {"bfloat16", kBfloat16}, {"float32", kFloat32}, {"float64", kFloat64},
      {"int32", kInt32},     {"int64", kInt64},       {"uint8", kUint8},     {"bool", kBool}};
  return all;
}
inline std::string name_of(const py::handle& dtype) { return py::cast<std::string>(py::str(dtype)).substr(6); }
inline unsigned mask_of(const std::string& name) {
  for (const auto& [each, mask] : masks()) {
    if (each == name) return mask;
  }
  return kOther;
}
// Returns the names of dtypes as in "float32, float64 or int32".
inline std::string names_of(unsigned dtypes) {
  std::string text;
  for (const auto& [name, mask] : masks()) {
    if ((dtypes & mask) == 0) continue;
    dtypes &= ~mask;
    text += (text.empty() ? "" : dtypes != 0 ? ", " : " or ") + name;
  }
  return text;
}
inline std::string text_of(const std::vector<std::string>& parts, const char* begin = "[", const char* end = "]") {
  std::string text = begin;
  for (size_t i = 0; i < parts.size(); ++i) text += (i == 0 ? "" : ", ") + parts[i];
  return text + end;
}

// Thrown if Python has to check a call, because only torch's compiler knows a size.
struct ForPython {};

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
    const auto found = std::find(names_.begin(), names_.end(), name);
    if (found == names_.end() && names_.size() == kMostLetters)
      throw std::invalid_argument("too many letters of shapes");
    const auto number = static_cast<int>(found - names_.begin());
    if (found == names_.end()) names_.push_back(name);
    return number;
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
  const std::vector<std::string>& names() const { return names_; }

 private:
  std::vector<std::string> names_;
};

// The values that all tensors of a call share: letters, dtype and device. Each checked tensor may add values.
struct Common {
  py::handle op;                          // the name of the op
  const std::vector<std::string>& names;  // the names of the letters
  int64_t letters[kMostLetters] = {};
  uint32_t bound = 0;
  unsigned first_float = 0;
  PyObject* first = nullptr;  // the first tensor, whose device all tensors have
  const std::string *first_name = nullptr, *float_name = nullptr;
  int32_t device_type = -1, device_index = 0;
  bool learns = false;                    // whether a tensor requires a gradient
  bool viewed = true;                     // whether torch gives views of all tensors
  std::list<std::vector<int64_t>> sizes;  // the shapes and strides of the other tensors

  Common(const py::handle& name, const Letters& all) : op(name), names(all.names()) {}
  bool bind(int letter, int64_t value) {
    if ((bound >> letter & 1) != 0) return letters[letter] == value;
    bound |= 1u << letter;
    letters[letter] = value;
    return true;
  }
  int64_t size(const Letters::Size& size) const {
    return size.letter < 0 ? size.more : letters[size.letter] + size.more;
  }
  template <typename Error>
  [[noreturn]] void refuse(const std::string& name, const std::string& rule, const std::string& actual = "") const {
    const auto begin = py::cast<std::string>(op) + ": " + name + " " + rule;
    throw Error(actual.empty() ? begin : begin + ", got " + actual);
  }
  // Fills the view of a tensor. If torch gives none (tensor_view.h), the facts come from Python (checks.facts), which
  // raises the error unless the object is a dense tensor.
  void look(const std::string& name, PyObject* tensor, TensorView& view) {
    if (view.look(tensor)) return;
    viewed = false;
    const py::tuple facts = py::handle(questions.checks).attr("facts")(op, name, py::handle(tensor));
    std::vector<int64_t>& all = sizes.emplace_back();
    for (int part = 0; part < 2; ++part) {
      for (const auto& size : facts[part]) {
        if (!PyLong_CheckExact(size.ptr())) throw ForPython();
        all.push_back(py::cast<int64_t>(size));
      }
    }
    view.dimensions = static_cast<int32_t>(all.size() / 2);
    view.shape = all.data();
    view.strides = view.shape + view.dimensions;
    view.mask = mask_of(name_of(facts[2]));
    static std::map<std::string, int32_t> types = {{"cpu", 1}, {"cuda", 2}};  // as in DLPack; other numbers are ours
    view.device_type =
        types.emplace(py::cast<std::string>(facts[3]), 100 + static_cast<int32_t>(types.size())).first->second;
    view.device_index = py::cast<int32_t>(facts[4]);
  }
};

// The rule of a tensor, as described by checks.TensorRule.
struct TensorRule {
  std::string name, like, empty;
  unsigned dtypes = 0;  // 0: the dtype of the first floating-point tensor
  bool wide = false, either = false, small = false, written = false;
  std::vector<Letters::Size> shape, otherwise;
  Letters::Size fallback;  // in a row of class checks.Default, no rule of a tensor: a letter and its default value

  static TensorRule of(const py::handle& row, Letters& letters) {
    TensorRule rule;
    if (py::hasattr(row, "letter")) {  // checks.Default
      rule.fallback = {letters.number(py::cast<std::string>(row.attr("letter"))),
                       py::cast<int64_t>(row.attr("number"))};
      return rule;
    }
    const auto text = [&row](const char* name) { return py::cast<std::string>(row.attr(name)); };
    const auto flag = [&row](const char* name) { return py::cast<bool>(row.attr(name)); };
    rule.name = text("name");
    rule.like = text("like");
    rule.empty = text("empty");
    for (const auto& dtype : row.attr("dtypes")) rule.dtypes |= mask_of(name_of(dtype));
    rule.wide = flag("wide");
    rule.either = flag("either");
    rule.small = flag("small");
    rule.written = flag("written");
    rule.shape = letters.sizes(row.attr("shape"));
    rule.otherwise = letters.sizes(row.attr("otherwise"));
    return rule;
  }
  // Checks a tensor, raises the error if it breaks the rule, and fills its view. `second`: it has the second shape.
  void check(PyObject* tensor, TensorView& view, bool second, Common& common) const {
    common.look(name, tensor, view);
    const auto& sizes = (second && !otherwise.empty()) || (either && view.dimensions != static_cast<int>(shape.size()))
                            ? otherwise
                            : shape;
    const uint32_t before = common.bound;
    bool fits = view.dimensions == static_cast<int>(sizes.size());
    for (int i = 0; fits && i < view.dimensions; ++i) {
      const Letters::Size& size = sizes[static_cast<size_t>(i)];
      const int64_t actual = view.shape[i];
      if (size.or_one && actual == 1) continue;
      fits =
          size.letter < 0 ? actual == size.more : actual >= size.more && common.bind(size.letter, actual - size.more);
      if (size.letter >= 0 && size.more == 1 && actual > kMostGroups + 1) {
        const auto most = std::to_string(kMostGroups + 1);
        common.refuse<py::value_error>(name, "must have at most " + most + " entries", std::to_string(actual));
      }
    }
    if (!fits) {
      common.refuse<py::value_error>(name, "must have shape " + text_of_shape(sizes, view, before, common),
                                     shape_of(view));
    }
    const int64_t rows = small ? view.entries() : view.dimensions > 0 ? view.shape[0] : 0;
    if (rows > kMostRows) py::handle(questions.checks).attr("check_count")(common.op, name, rows);
    const unsigned dtype = view.dtype(), first = common.first_float;
    const unsigned allowed = dtypes != 0  ? dtypes
                             : first == 0 ? kFloating
                                          : (wide && first != kFloat64 ? kFloat32 : first);
    if ((dtype & allowed) == 0) {
      const std::string& other = !like.empty() || dtypes != 0 || wide || first == 0 ? like : *common.float_name;
      common.refuse<py::type_error>(
          name, (other.empty() ? "must have dtype " : "must have the dtype of " + other + ", ") + names_of(allowed),
          name_of(py::handle(tensor).attr("dtype")));
    }
    if (first == 0 && (dtype & kFloating) != 0) {
      common.first_float = dtype;
      common.float_name = &name;
    }
    if (common.first == nullptr) {
      common.first = tensor;
      common.first_name = &name;
      common.device_type = view.device_type;
      common.device_index = view.device_index;
    } else if (common.device_type != view.device_type || common.device_index != view.device_index) {
      const auto device = [](PyObject* each) {
        return py::cast<std::string>(py::str(py::handle(each).attr("device")));
      };
      const std::string rule = "must be on the device of " + *common.first_name + ", " + device(common.first);
      common.refuse<py::value_error>(name, rule, device(tensor));
    }
    if (!empty.empty() && view.shape[0] <= sizes[0].more) common.refuse<py::value_error>(name, empty, shape_of(view));
  }
  // Checks the memory of a tensor that the op writes into.
  void check_memory(PyObject* tensor, const TensorView& view, const Common& common) const {
    if (!written) return;
    if (!view.is_contiguous()) {
      const auto strides = py::cast<std::string>(py::str(py::handle(tensor).attr("stride")()));
      common.refuse<py::value_error>(name, "must be contiguous", "strides " + strides);
    }
    if (is_negative(tensor)) common.refuse<py::value_error>(name, "must not be a negative view: clone it");
  }

 private:
  static std::string shape_of(const TensorView& view) {
    std::vector<std::string> sizes;
    for (int i = 0; i < view.dimensions; ++i) sizes.push_back(std::to_string(view.shape[i]));
    return text_of(sizes);
  }
  // Returns "[k, 3] with k = 2": a shape with the values of the letters that other tensors had bound.
  static std::string text_of_shape(const std::vector<Letters::Size>& sizes, const TensorView& view, uint32_t before,
                                   const Common& common) {
    std::vector<std::string> entries, values;
    for (const Letters::Size& size : sizes) {
      const bool one = size.letter < 0 || (size.or_one && view.dimensions > 0 && view.shape[0] == 1);
      const std::string letter = one ? "" : common.names[static_cast<size_t>(size.letter)];
      entries.push_back(one ? std::to_string(size.letter < 0 ? size.more : 1) : letter + (size.more == 1 ? "+1" : ""));
      if (one || (before >> size.letter & 1) == 0) continue;
      const std::string value = letter + " = " + std::to_string(common.letters[size.letter]);
      if (std::find(values.begin(), values.end(), value) == values.end()) values.push_back(value);
    }
    return text_of(entries) + (values.empty() ? "" : text_of(values, " with ", ""));
  }
};

// Refuses a tensor that autograd cannot save; the call records gradients.
inline void refuse_inference(const std::string& name, PyObject* tensor, const Common& common) {
  if (!is_inference(tensor)) return;
  common.refuse<py::type_error>(name, "must not be an inference tensor while gradients are recorded: clone it");
}

// The rules for a list of tensors that are not separate arguments, such as the tensors of a network.
class TensorRules {
 public:
  // Reads rows of checks.py, of the classes TensorRule and Default.
  explicit TensorRules(const py::sequence& rows) {
    for (const auto& row : rows) rules_.push_back(TensorRule::of(row, letters_));
    for (const std::string& name : letters_.names()) words_.push_back(py::str(name));
  }
  // Checks the tensors and raises the error. `smooth`: autograd saves the tensors. Returns the values of the letters
  // (0: unbound); None if Python has to check the tensors.
  py::object check(const py::handle& op, const py::list& tensors, bool smooth) const {
    Common common(op, letters_);
    Py_ssize_t i = 0;
    for (const TensorRule& rule : rules_) {
      const auto [letter, number, or_one] = rule.fallback;
      if (letter >= 0) {
        if ((common.bound >> letter & 1) == 0) common.bind(letter, number);
        continue;
      }
      if (i == PyList_GET_SIZE(tensors.ptr())) throw std::invalid_argument("fewer tensors than rules");
      PyObject* const tensor = PyList_GET_ITEM(tensors.ptr(), i++);
      TensorView view;
      try {
        rule.check(tensor, view, false, common);
        rule.check_memory(tensor, view, common);
      } catch (const ForPython&) {
        return py::none();
      }
      common.learns = common.learns || (smooth && (view.dtype() & kFloating) != 0 && requires_gradient(tensor));
    }
    if (common.learns && questions.grad()) {
      i = 0;
      for (const TensorRule& rule : rules_) {
        if (rule.fallback.letter < 0) refuse_inference(rule.name, PyList_GET_ITEM(tensors.ptr(), i++), common);
      }
    }
    py::dict result;
    for (size_t letter = 0; letter < words_.size(); ++letter) result[words_[letter]] = common.letters[letter];
    return std::move(result);
  }

 private:
  Letters letters_;
  std::vector<TensorRule> rules_;
  std::vector<py::str> words_;  // the letters
};

}  // namespace voronerf
