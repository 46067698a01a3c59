// Whether objects of Python are as they were: what a step, a router or a field was made for, asked in every call.
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

// A value is unchanged as long as it is the same object, or an equal number, text or device. Whatever is noted is held,
// with the storages of tensors: memory that a tensor has left (`x.data = y`) is not freed.
class Unchanged {
 public:
  // What a list, a tuple, a set or a dictionary holds, in its order; under the keys `free` of a dictionary any value.
  void contents(const py::object& container, const std::vector<std::string>& free);
  // Some entries of a dictionary: their values, or that there are none.
  void entries(const py::dict& dictionary, const std::vector<std::string>& names);
  void attributes(const py::object& object, const std::vector<std::string>& names);
  // What a function answers without arguments.
  void answer(const py::object& function);
  // Where the memory of a tensor is; or that, and how it lies there.
  void place(const py::object& tensor) { add(tensor, false); }
  void layout(const py::object& tensor) { add(tensor, true); }
  // Sizes, dtype and device of the tensor that is an entry of a dictionary, whichever tensor it is.
  void kind(const py::dict& dictionary, const std::string& name);

  // Compares as little as may be: between the kernels of a loop, whatever is looked at must come from memory.
  bool holds() const;

  int each_held(const Visit& visit) const;
  void release() { *this = {}; }

 private:
  // How a tensor was.
  struct Seen {
    Seen(PyObject* tensor, bool place, bool layout);
    bool holds(PyObject* tensor) const;
    std::vector<py::object> ask(PyObject* tensor) const;

    bool place, layout;
    TensorView view;
    std::vector<int64_t> sizes, strides;
    std::vector<py::object> answers;  // of the methods of a tensor that gives no view
  };
  struct Container {
    py::object container;
    std::vector<py::object> values;  // of a dictionary with their keys; null for any
  };
  struct Named {
    py::object owner, name, value;  // null for none
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

  std::vector<std::pair<py::object, py::object>> answers_;  // by function
  std::vector<Container> containers_;
  std::vector<Named> entries_, attributes_;
  std::vector<Tensor> tensors_;
  std::set<std::pair<PyObject*, bool>> known_;  // of these
  std::vector<Kind> kinds_;
};

void bind_unchanged(py::module_& module);

}  // namespace voronerf
