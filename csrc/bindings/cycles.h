// Classes whose objects hold objects of Python, which may hold them: Python's collector finds such cycles.
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

// For a class with each_held(visit), which calls visit with each object that is held, or null, until that gives
// something else than 0, and gives that; and with release().
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
