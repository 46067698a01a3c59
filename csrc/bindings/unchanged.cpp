#include "bindings/unchanged.h"

#include <pybind11/stl.h>

#include <algorithm>
#include <cstring>

namespace voronerf {

namespace {

bool are_equal(PyObject* one, PyObject* other) {
  const int equal = one == nullptr || other == nullptr ? 0 : PyObject_RichCompareBool(one, other, Py_EQ);
  PyErr_Clear();
  return equal == 1;
}

bool is_same(PyObject* was, PyObject* is) {
  if (was == is) return true;
  if (was == nullptr || is == nullptr || Py_TYPE(was) != Py_TYPE(is)) return false;
  const bool plain = PyLong_Check(is) || PyFloat_Check(is) || PyUnicode_Check(is) || PyComplex_Check(is) ||
                     std::strcmp(Py_TYPE(is)->tp_name, "torch.device") == 0;
  return plain && are_equal(was, is);
}

// Calls look(key or null, value) for each element of a container until a call returns false. Returns whether all calls
// returned true.
template <typename Look>
bool each(PyObject* container, Look&& look) {
  if (PyDict_Check(container)) {
    PyObject *key, *value;
    for (Py_ssize_t at = 0; PyDict_Next(container, &at, &key, &value) != 0;) {
      if (!look(key, value)) return false;
    }
    return true;
  }
  if (PyList_Check(container) || PyTuple_Check(container)) {
    for (Py_ssize_t i = 0; i < PySequence_Fast_GET_SIZE(container); ++i) {
      if (!look(nullptr, PySequence_Fast_GET_ITEM(container, i))) return false;
    }
    return true;
  }
  const auto items = py::reinterpret_steal<py::object>(PyObject_GetIter(container));
  if (!items) throw py::error_already_set();
  while (const auto item = py::reinterpret_steal<py::object>(PyIter_Next(items.ptr()))) {
    if (!look(nullptr, item.ptr())) return false;
  }
  return true;
}

// Returns whether the entries at `at`, from dimension `d` of the view on, have the bytes of a contiguous copy, and
// moves `copy` behind these bytes.
bool has_bytes(const TensorView& view, int d, const char* at, const char*& copy, int64_t size) {
  if (d == view.dimensions) {
    copy += size;
    return std::memcmp(at, copy - size, static_cast<size_t>(size)) == 0;
  }
  for (int64_t i = 0; i < view.shape[d]; ++i) {
    if (!has_bytes(view, d + 1, at + i * view.strides[d] * size, copy, size)) return false;
  }
  return true;
}

bool has_values(PyObject* tensor, PyObject* copied) {
  TensorView view, copy;
  if (!view.look(tensor) || !copy.look(copied)) {
    static PyObject* const word = PyUnicode_InternFromString("equal");
    const auto answer = py::reinterpret_steal<py::object>(PyObject_CallMethodOneArg(tensor, word, copied));
    PyErr_Clear();
    return answer.ptr() == Py_True;
  }
  if (!view.on_cpu()) return false;
  if (view.code != copy.code || view.bits != copy.bits || view.dimensions != copy.dimensions) return false;
  if (!std::equal(view.shape, view.shape + view.dimensions, copy.shape)) return false;
  const int64_t size = view.bits * view.lanes / 8;
  const char* bytes = static_cast<const char*>(copy.address());
  if (!view.is_contiguous()) return has_bytes(view, 0, static_cast<const char*>(view.address()), bytes, size);
  return std::memcmp(view.address(), bytes, static_cast<size_t>(view.entries() * size)) == 0;
}

py::object attribute_of(PyObject* owner, PyObject* name) {
  auto value = py::reinterpret_steal<py::object>(PyObject_GetAttr(owner, name));
  PyErr_Clear();
  return value;
}

py::object interned(const std::string& name) {
  return py::reinterpret_steal<py::object>(PyUnicode_InternFromString(name.c_str()));
}

}  // namespace

Unchanged::Seen::Seen(PyObject* tensor, bool place, bool layout) : place(place), layout(layout) {
  if (view.look(tensor)) {
    sizes.assign(view.shape, view.shape + view.dimensions);
    strides.assign(view.strides, view.strides + view.dimensions);
  } else {
    answers = ask(tensor);
  }
}

std::vector<py::object> Unchanged::Seen::ask(PyObject* tensor) const {
  std::vector<py::object> found;
  const auto add = [&](const char* name, bool method) {
    auto answer = py::reinterpret_steal<py::object>(PyObject_GetAttrString(tensor, name));
    if (answer && method) answer = py::reinterpret_steal<py::object>(PyObject_CallNoArgs(answer.ptr()));
    PyErr_Clear();
    found.push_back(answer);
  };
  if (place) add("data_ptr", true);
  if (layout) add("size", true);
  if (layout && place) add("stride", true);
  if (!place) add("dtype", false);
  if (!place) add("device", false);
  return found;
}

bool Unchanged::Seen::holds(PyObject* tensor) const {
  if (!answers.empty()) {
    const std::vector<py::object> now = ask(tensor);
    return std::equal(answers.begin(), answers.end(), now.begin(), [](const py::object& was, const py::object& is) {
      return (!was && !is) || are_equal(was.ptr(), is.ptr());
    });
  }
  TensorView now;
  if (!now.look(tensor)) return false;
  if (place && now.address() != view.address()) return false;
  const bool like = now.code == view.code && now.bits == view.bits && now.device_type == view.device_type &&
                    now.device_index == view.device_index;
  if (!place && !like) return false;
  if (!layout) return true;
  if (now.dimensions != view.dimensions || !std::equal(sizes.begin(), sizes.end(), now.shape)) return false;
  return !place || std::equal(strides.begin(), strides.end(), now.strides);
}

void Unchanged::contents(const py::object& container, const std::vector<std::string>& free, const py::object& read) {
  Container noted{container, {}, read};
  each(container.ptr(), [&](PyObject* key, PyObject* value) {
    bool any = false;
    if (key != nullptr) {
      noted.values.push_back(py::reinterpret_borrow<py::object>(key));
      any = PyUnicode_Check(key) && std::find(free.begin(), free.end(), py::cast<std::string>(key)) != free.end();
    }
    noted.values.push_back(any ? py::object() : py::reinterpret_borrow<py::object>(value));
    return true;
  });
  containers_.push_back(std::move(noted));
}

void Unchanged::entries(const py::dict& dictionary, const std::vector<std::string>& names) {
  for (const std::string& name : names) {
    const py::object key = interned(name);
    PyObject* const value = PyDict_GetItemWithError(dictionary.ptr(), key.ptr());
    entries_.push_back({dictionary, key, py::reinterpret_borrow<py::object>(value)});
  }
}

void Unchanged::attributes(const py::object& object, const std::vector<std::string>& names) {
  for (const std::string& name : names) {
    const py::object key = interned(name);
    attributes_.push_back({object, key, attribute_of(object.ptr(), key.ptr())});
  }
}

void Unchanged::answer(const py::object& function) { answers_.emplace_back(function, function()); }

void Unchanged::add(const py::object& tensor, bool layout) {
  if (!known_.insert({tensor.ptr(), layout}).second) return;
  tensors_.push_back({tensor, tensor.attr("untyped_storage")(), Seen(tensor.ptr(), true, layout)});
}

void Unchanged::kind(const py::dict& dictionary, const std::string& name) {
  const py::object key = interned(name);
  PyObject* const tensor = PyDict_GetItemWithError(dictionary.ptr(), key.ptr());
  if (tensor == nullptr) throw py::key_error(name);
  kinds_.push_back({dictionary, key, Seen(tensor, false, true)});
}

bool Unchanged::holds() const {
  for (const Container& noted : containers_) {
    if (noted.values.empty() && PyDict_Check(noted.container.ptr())) {  // the usual case: dictionaries of hooks
      if (PyDict_GET_SIZE(noted.container.ptr()) != 0) return false;
      continue;
    }
    size_t i = 0;
    const bool all = each(noted.container.ptr(), [&](PyObject* key, PyObject* value) {
      const auto matters = [&] { return noted.read.is_none() || PySet_Contains(noted.read.ptr(), key) != 0; };
      if (i == noted.values.size()) return !matters();  // a new element
      if (key != nullptr && !is_same(noted.values[i++].ptr(), key)) return false;
      PyObject* const was = noted.values[i++].ptr();
      return was == nullptr || is_same(was, value) || !matters();
    });
    if (!all || i != noted.values.size()) return false;
  }
  for (const Named& noted : entries_) {
    if (!is_same(noted.value.ptr(), PyDict_GetItemWithError(noted.owner.ptr(), noted.name.ptr()))) return false;
  }
  for (const Named& noted : attributes_) {
    if (!is_same(noted.value.ptr(), attribute_of(noted.owner.ptr(), noted.name.ptr()).ptr())) return false;
  }
  for (const auto& [function, was] : answers_) {
    if (!is_same(was.ptr(), function().ptr())) return false;
  }
  for (const auto& [tensor, copy] : values_) {
    if (!has_values(tensor.ptr(), copy.ptr())) return false;
  }
  for (const Kind& noted : kinds_) {
    PyObject* const tensor = PyDict_GetItemWithError(noted.dictionary.ptr(), noted.name.ptr());
    if (tensor == nullptr || tensor == Py_None || !noted.seen.holds(tensor)) return false;
  }
  return std::all_of(tensors_.begin(), tensors_.end(),
                     [](const Tensor& noted) { return noted.seen.holds(noted.tensor.ptr()); });
}

int Unchanged::each_held(const Visit& visit) const {
  std::vector<PyObject*> held;
  for (const Container& noted : containers_) {
    held.insert(held.end(), {noted.container.ptr(), noted.read.ptr()});
    for (const py::object& value : noted.values) held.push_back(value.ptr());
  }
  for (const std::vector<Named>* named : {&entries_, &attributes_}) {
    for (const Named& noted : *named) held.insert(held.end(), {noted.owner.ptr(), noted.value.ptr()});
  }
  for (const auto* pairs : {&answers_, &values_}) {
    for (const auto& [one, other] : *pairs) held.insert(held.end(), {one.ptr(), other.ptr()});
  }
  for (const Tensor& noted : tensors_) held.insert(held.end(), {noted.tensor.ptr(), noted.storage.ptr()});
  for (const Kind& noted : kinds_) held.push_back(noted.dictionary.ptr());
  int status = 0;
  for (size_t i = 0; i < held.size() && status == 0; ++i) status = visit(held[i]);
  return status;
}

void bind_unchanged(py::module_& module) {
  py::class_<Unchanged>(module, "Unchanged", py::module_local(), in_cycles<Unchanged>())
      .def(py::init())
      .def("contents", &Unchanged::contents, py::arg("container"), py::arg("free") = py::tuple(),
           py::arg("read") = py::none())
      .def("entries", &Unchanged::entries)
      .def("attributes", &Unchanged::attributes)
      .def("answer", &Unchanged::answer)
      .def("place", &Unchanged::place)
      .def("layout", &Unchanged::layout)
      .def("values", &Unchanged::values)
      .def("kind", &Unchanged::kind)
      .def("holds", &Unchanged::holds);
}

}  // namespace voronerf
