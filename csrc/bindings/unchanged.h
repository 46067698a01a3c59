// A check that runs in every call: the Python objects for which a step, router or field was prepared must be unchanged.
#pragma once

#include <pybind11/pybind11.h>

#include <set>
#include <string>
#include <utility>
#include <vector>

#include "bindings/cycles.h"
#include "bindings/tensor_view.h"

namespace voronerf {

namespace py = pybind11;

// A value is unchanged if it is the same object, or an equal number, text or device. The noted objects and the storages
// of tensors are held, so the memory of a tensor is not freed after `x.data = y`.
class Unchanged {
 public:
  // Notes the elements of a list, tuple, set or dictionary in order. The values of the keys `free` may change and, if
  // `read` is a set instead of None, the values of keys that are not in this set at the time of `holds`.
  void contents(const py::object& container, const std::vector<std::string>& free, const py::object& read);
  // Notes the values of some keys of a dictionary, or that the keys are missing.
  void entries(const py::dict& dictionary, const std::vector<std::string>& names);
  void attributes(const py::object& object, const std::vector<std::string>& names);
  // Notes the result of function().
  void answer(const py::object& function);
  // Notes the address of a tensor's memory (place), or also its sizes and strides (layout).
  void place(const py::object& tensor) { add(tensor, false); }
  void layout(const py::object& tensor) { add(tensor, true); }
  // Notes the values of a tensor on the CPU, of which `copy` is a contiguous copy. Unlike the version counter, the
  // values also show writes through `tensor.data` and into inference tensors.
  void values(const py::object& tensor, const py::object& copy) { values_.emplace_back(tensor, copy); }
  // Notes the sizes, dtype and device of the tensor under a key of a dictionary. The tensor itself may change.
  void kind(const py::dict& dictionary, const std::string& name);

  // Returns whether all noted objects are unchanged. It reads as little as possible: between the kernels of a loop,
  // each read is a cache miss.
  bool holds() const;

  int each_held(const Visit& visit) const;
  void release() { *this = {}; }

 private:
  // The noted state of a tensor.
  struct Seen {
    Seen(PyObject* tensor, bool place, bool layout);
    bool holds(PyObject* tensor) const;
    std::vector<py::object> ask(PyObject* tensor) const;

    bool place, layout;
    TensorView view;
    std::vector<int64_t> sizes, strides;
    std::vector<py::object> answers;  // results of the methods of a tensor without a view
  };
  struct Container {
    py::object container;
    std::vector<py::object> values;  // for a dictionary, keys and values alternate; null: any value
    py::object read;                 // the keys whose values matter; None: all
  };
  struct Named {
    py::object owner, name, value;  // null value: none
  };
  struct Tensor {
    py::object tensor, storage;
    Seen seen;
  };
  struct Kind {
    py::dict dictionary;
    py::object name;
    Seen seen;
  };
  void add(const py::object& tensor, bool layout);

  std::vector<std::pair<py::object, py::object>> answers_;  // functions and their results
  std::vector<std::pair<py::object, py::object>> values_;   // tensors and copies of their values
  std::vector<Container> containers_;
  std::vector<Named> entries_, attributes_;
  std::vector<Tensor> tensors_;
  std::set<std::pair<PyObject*, bool>> known_;  // the tensors in tensors_, with their `layout`
  std::vector<Kind> kinds_;
};

void bind_unchanged(py::module_& module);

}  // namespace voronerf
