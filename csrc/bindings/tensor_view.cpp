#include "bindings/tensor_view.h"

#include <Python.h>

namespace voronerf {

namespace {

// The first fields of DLPackExchangeAPI. Only `look` is called.
struct Exchange {
  uint32_t major, minor;
  void *previous, *allocate, *managed_from_python, *managed_to_python;
  int (*look)(void* tensor, TensorView* view);
};
const Exchange* exchange = nullptr;
PyObject* plain_classes = nullptr;

}  // namespace

bool TensorView::look(PyObject* tensor) {
  if (exchange == nullptr) return false;
  auto* const kind = reinterpret_cast<PyObject*>(Py_TYPE(tensor));
  bool plain = false;
  for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(plain_classes); ++i) plain |= kind == PyTuple_GET_ITEM(plain_classes, i);
  if (!plain) return false;
  if (exchange->look(tensor, this) != 0) return PyErr_Clear(), false;
  if (!on_cpu() && !on_cuda()) return *this = {}, false;
  return data != nullptr || entries() == 0;  // false if its memory was freed, for example by storage.resize_
}

bool is_negative(PyObject* tensor) {
  static PyObject* const word = PyUnicode_InternFromString("is_neg");
  PyObject* const answer = PyObject_CallMethodNoArgs(tensor, word);
  PyErr_Clear();
  Py_XDECREF(answer);  // True and False are never freed
  return answer != Py_False;
}

void know_tensors(PyObject* classes, PyObject* capsule) {
  Py_INCREF(classes);
  plain_classes = classes;
  exchange = nullptr;
  if (capsule == Py_None) return;
  const auto* const found = static_cast<const Exchange*>(PyCapsule_GetPointer(capsule, "dlpack_exchange_api"));
  if (found != nullptr && found->major == 1) exchange = found;
  PyErr_Clear();
}

}  // namespace voronerf
