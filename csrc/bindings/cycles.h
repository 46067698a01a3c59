// Support of Python's cyclic garbage collector for C++ classes that hold Python objects.
#pragma once

#include <pybind11/pybind11.h>

#include <functional>

namespace voronerf {

using Visit = std::function<int(PyObject*)>;

template <typename T>
T* value_in(PyObject* self) {
  auto value = reinterpret_cast<pybind11::detail::instance*>(self)->get_value_and_holder();
  return value.holder_constructed() ? value.value_ptr<T>() : nullptr;
}

// Returns the type setup of a class T with two methods. each_held(visit) calls visit with each held object (or null)
// until visit returns a non-zero status, and returns the status. release() drops the held objects.
template <typename T>
pybind11::custom_type_setup in_cycles() {
  return pybind11::custom_type_setup([](PyHeapTypeObject* heap_type) {
    PyTypeObject& type = heap_type->ht_type;
    type.tp_flags |= Py_TPFLAGS_HAVE_GC;
    type.tp_traverse = [](PyObject* self, visitproc visit, void* arg) {
      Py_VISIT(Py_TYPE(self));
      const T* const value = value_in<T>(self);
      return value == nullptr
                 ? 0
                 : value->each_held([&](PyObject* object) { return object == nullptr ? 0 : visit(object, arg); });
    };
    type.tp_clear = [](PyObject* self) {
      if (T* const value = value_in<T>(self)) value->release();
      return 0;
    };
  });
}

}  // namespace voronerf
