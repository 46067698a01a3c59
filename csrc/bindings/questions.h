// The state of torch and voronerf that every call queries, through Python functions that the module receives once.
#pragma once

#include <vector>

#include "bindings/frame.h"

namespace voronerf {

inline bool is_true(PyObject* answer) {
  PyErr_Clear();
  Py_XDECREF(answer);
  return answer == Py_True;
}
inline bool requires_gradient(PyObject* tensor) {
  static PyObject* const word = PyUnicode_InternFromString("requires_grad");
  return is_true(PyObject_GetAttr(tensor, word));
}
inline bool is_inference(PyObject* tensor) {
  static PyObject* const word = PyUnicode_InternFromString("is_inference");
  return is_true(PyObject_CallMethodNoArgs(tensor, word));
}

// Queries of the state of torch and voronerf. The Python objects live as long as the interpreter.
struct Questions {
  PyObject *own = nullptr, *torch = nullptr, *grad_enabled = nullptr, *tangents = nullptr, *threads = nullptr,
           *kept = nullptr, *native = nullptr, *choose = nullptr, *checks = nullptr;
  std::vector<PyObject*> listeners;
  std::map<unsigned, PyObject*> dtypes;

  bool grad() const { return is_true(PyObject_CallNoArgs(grad_enabled)); }
  // Returns whether a mode, transform, tracer or profiler of torch must see the call, or forward-mode differentiation
  // is active.
  bool has_listeners() const {
    for (PyObject* listener : listeners) {
      PyObject* const answer = PyObject_CallNoArgs(listener);
      const bool listens = answer == nullptr || PyObject_IsTrue(answer) != 0;
      PyErr_Clear();
      Py_XDECREF(answer);
      if (listens) return true;
    }
    static PyObject* const word = PyUnicode_InternFromString("_current_level");
    PyObject* const level = PyDict_GetItemWithError(tangents, word);
    return level == nullptr || PyLong_AsLong(level) >= 0;
  }
  // Allocates a CPU tensor of a dtype. `like` is null or a CPU tensor of this dtype, whose method `new_empty` takes two
  // thirds of the time of torch.empty, which has to read a dtype.
  py::object new_memory(const std::vector<int64_t>& shape, PyObject* dtype, PyObject* like) const {
    static PyObject *const word = PyUnicode_InternFromString("empty"),
                           *const method = PyUnicode_InternFromString("new_empty"),
                           *const names = PyTuple_Pack(1, PyUnicode_InternFromString("dtype"));
    constexpr size_t kMost = 8;
    PyObject* arguments[kMost + 2];
    size_t count = 0;
    if (shape.size() > kMost) throw std::invalid_argument("too many dimensions");
    arguments[count++] = like;
    for (const int64_t size : shape) arguments[count++] = PyLong_FromLongLong(size);
    if (shape.empty()) arguments[count++] = PyTuple_New(0);
    arguments[count] = dtype;
    PyObject* const tensor =
        like != nullptr ? PyObject_VectorcallMethod(method, arguments, count, nullptr)
                        : PyObject_Vectorcall(PyDict_GetItemWithError(torch, word), arguments + 1, count - 1, names);
    for (size_t i = 1; i < count; ++i) Py_DECREF(arguments[i]);
    if (tensor == nullptr) throw py::error_already_set();
    return py::reinterpret_steal<py::object>(tensor);
  }
  // Returns the instruction set and the number of threads, like native.cpu() in Python.
  Cpu cpu() const {
    static PyObject *const isa_word = PyUnicode_InternFromString("_isa"), *const threads_word =
                                                                              PyUnicode_InternFromString("threads");
    static PyObject* cached_name = nullptr;  // the name of `isa`, which almost never changes
    static Isa isa;
    PyObject* const name = PyDict_GetItemWithError(native, isa_word);
    if (name != cached_name) {
      Frame frame;
      void* place = &isa;
      if (!frame.load(type_of<Isa>(), name, place)) throw py::type_error("_isa");
      Py_INCREF(name);
      cached_name = name;
    }
    PyObject* count = PyObject_GetAttr(kept, threads_word);
    if (count == Py_None) {
      Py_DECREF(count);
      count = PyObject_CallNoArgs(threads);
    }
    const auto thread_count = static_cast<int>(PyLong_AsLong(count));
    Py_XDECREF(count);
    return {isa, thread_count};
  }
  // Returns whether voronerf uses this module: tests may replace native.compiled with another module.
  bool compiled_here() const {
    static PyObject* const word = PyUnicode_InternFromString("compiled");
    return native != nullptr && PyDict_GetItemWithError(native, word) == own;
  }
};
inline Questions questions;

}  // namespace voronerf
