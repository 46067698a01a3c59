// The arguments of a call from Python, converted for C++. Only files that use pybind11 include this header.
#pragma once

#include <pybind11/pybind11.h>

#include <cstring>
#include <list>
#include <map>
#include <stdexcept>

#include "bindings/bind.h"
#include "bindings/tensor_view.h"

namespace voronerf {

namespace py = pybind11;

constexpr size_t kMostParameters = 24;
constexpr size_t kMostBytes = 2048;  // limit for all parameters of a call

struct Bound {
  Module::AnyFunction function;
  Module::Caller call;
  std::vector<const Type*> given;       // parameters in Python
  std::vector<const Type*> parameters;  // parameters of the C++ function
  const Type *result, *machine;         // null: none
};

struct Function {
  std::string name;
  std::vector<Bound> overloads;
};

inline std::map<std::string, Function>& functions() {
  static std::map<std::string, Function> all;
  return all;
}

// Returns the Python objects of torch's dtypes, by the names of load.h.
inline std::map<std::string, PyObject*>& dtypes() {
  static std::map<std::string, PyObject*> objects;
  return objects;
}

class Recording;
inline Recording*& recording() {  // the active recording of the calling thread, or null
  static thread_local Recording* recording = nullptr;
  return recording;
}
void refuse(Recording& recording, const std::string& why);
bool add_tensor(Recording& recording, PyObject* tensor);

// Returns whether the object is a tuple of `count` entries. The class of a named tuple does not tell its length:
// tuple.__new__(Class, ()) has no entries.
inline bool has_entries(PyObject* object, size_t count) {
  return PyTuple_Check(object) && PyTuple_GET_SIZE(object) == static_cast<Py_ssize_t>(count);
}

// The Python references that a call holds, released when it ends.
class Frame {
 public:
  // A row count of a recorded call: each replay sets *rows = *memory + offset, where *memory is at most `capacity`.
  struct Counted {
    RowCount* rows;
    const int64_t* memory;
    int64_t offset, capacity;
  };
  Frame() { kept_.reserve(16); }
  const std::vector<PyObject*>& kept() const { return kept_; }
  Frame(const Frame&) = delete;
  Frame& operator=(const Frame&) = delete;
  ~Frame() {
    for (PyObject* each : kept_) Py_DECREF(each);
  }

  const std::vector<Counted>& counted() const { return counted_; }
  bool misses_rows() const { return has_rows_ && counted_.empty(); }

  // Loads a value into `place`. Returns false if the value is not of the type. For an opaque object, `place` becomes
  // its address.
  bool load(const Type& type, PyObject* object, void*& place) {
    switch (type.kind) {
      case Type::Kind::boolean:
        if (!PyBool_Check(object)) return false;
        *static_cast<bool*>(place) = object == Py_True;
        return true;
      case Type::Kind::integer: {
        if (!PyLong_Check(object)) return false;
        const auto value =
            type.is_signed ? PyLong_AsLongLong(object) : static_cast<long long>(PyLong_AsUnsignedLongLong(object));
        if (value == -1 && PyErr_Occurred() != nullptr) return PyErr_Clear(), false;
        store(place, value, type.size);
        return true;
      }
      case Type::Kind::rows: {
        if (!PyLong_Check(object)) return false;
        const int64_t rows = PyLong_AsLongLong(object);
        if (rows == -1 && PyErr_Occurred() != nullptr) return PyErr_Clear(), false;
        *static_cast<RowCount*>(place) = rows;
        if (recording() != nullptr && rows != 0) count(object, *static_cast<RowCount*>(place));
        return true;
      }
      case Type::Kind::floating: {
        if (!PyFloat_Check(object) && !PyLong_Check(object)) return false;
        const double value = PyFloat_AsDouble(object);
        if (type.size == sizeof(float)) {
          *static_cast<float*>(place) = static_cast<float>(value);
        } else {
          *static_cast<double*>(place) = value;
        }
        return true;
      }
      case Type::Kind::enumeration:
        if (!PyUnicode_Check(object)) return false;
        for (size_t i = 0; i < type.values.size(); ++i) {
          if (PyUnicode_CompareWithASCIIString(object, type.values[i].c_str()) != 0) continue;
          store(place, static_cast<long long>(i), type.size);
          return true;
        }
        return false;
      case Type::Kind::text:
        if (!PyUnicode_Check(object)) return false;
        *static_cast<const char**>(place) = PyUnicode_AsUTF8(object);
        keep(object);  // the string owns the characters
        return *static_cast<const char**>(place) != nullptr;
      case Type::Kind::tensor:
        return load_tensor(type, object, *static_cast<void**>(place));
      case Type::Kind::tensors:
        *static_cast<void***>(place) = nullptr;
        if (object == Py_None) return true;
        return load_sequence(*type.of, object,
                             [&](size_t count) { return *static_cast<void***>(place) = array(count); });
      case Type::Kind::sequence:
        return load_sequence(*type.of, object, [&](size_t count) { return type.resize(place, count); });
      case Type::Kind::structure:
        return load_structure(type, object, static_cast<char*>(place));
      case Type::Kind::custom:
        return type.load(this, object, place);
      case Type::Kind::opaque:
        if (!PyCapsule_IsValid(object, type.exact.c_str())) return false;
        place = PyCapsule_GetPointer(object, type.exact.c_str());
        keep(object);
        return true;
      default:
        return false;
    }
  }

  // Loads a tensor whose view is known.
  bool load_view(const Type& type, PyObject* object, const TensorView& view, void*& address) {
    if (type.dtypes != 0 && (view.dtype() & type.dtypes) == 0) return false;
    if (!view.is_contiguous() || is_negative(object)) return load_by_methods(type, object, address);
    keep(object);
    address = view.address();
    if (recording() != nullptr && add_tensor(*recording(), object)) has_rows_ = true;
    return true;
  }
  // Returns an array of addresses that lives as long as the call.
  void** array(size_t count) { return arrays_.emplace_back(count + 1).data(); }
  // Holds a reference to the object during the call.
  void keep(PyObject* object) {
    Py_INCREF(object);
    kept_.push_back(object);
  }

 private:
  static void store(void* place, long long value, size_t size) { std::memcpy(place, &value, size); }

  // Records a RowCount of voronerf/ops/_core/rows.py, a subclass of int. A plain int cannot be recorded.
  void count(PyObject* object, RowCount& rows) {
    if (PyLong_CheckExact(object)) {
      const std::string value = std::to_string(rows.value);
      return refuse(*recording(), "a row count is a plain int that a replay cannot read again: " + value);
    }
    const auto number = [object](const char* name) { return py::cast<int64_t>(py::handle(object).attr(name)); };
    const auto* memory = reinterpret_cast<const int64_t*>(py::cast<std::uintptr_t>(py::handle(object).attr("address")));
    counted_.push_back({&rows, memory, number("offset"), number("capacity")});
    keep(object);  // the RowCount holds the memory
  }

  bool load_tensor(const Type& type, PyObject* object, void*& address) {
    address = nullptr;
    if (object == Py_None) return true;
    TensorView view;
    return view.look(object) ? load_view(type, object, view, address) : load_by_methods(type, object, address);
  }

  // Loads any object with dtype, contiguous(), is_contiguous(), is_neg(), resolve_neg() and data_ptr().
  bool load_by_methods(const Type& type, PyObject* object, void*& address) {
    static PyObject *const dtype_word = PyUnicode_InternFromString("dtype"),
                           *const address_word = PyUnicode_InternFromString("data_ptr"),
                           *const resolve_word = PyUnicode_InternFromString("resolve_neg"),
                           *const contiguous_word = PyUnicode_InternFromString("contiguous"),
                           *const is_contiguous_word = PyUnicode_InternFromString("is_contiguous");
    if (type.dtypes != 0) {
      if (type.known_dtype == nullptr) type.known_dtype = dtypes().at(type.dtype);
      PyObject* const dtype = PyObject_GetAttr(object, dtype_word);
      Py_XDECREF(dtype);  // dtypes are never freed
      const bool matches = dtype == type.known_dtype || ((type.dtypes & kBool) != 0 && dtype == dtypes().at("bool"));
      if (!matches) return PyErr_Clear(), false;
    }
    PyObject* const reference = PyObject_CallMethodNoArgs(object, type.constant ? contiguous_word : is_contiguous_word);
    if (reference == nullptr) throw py::error_already_set();  // out of memory
    if (type.constant) {
      kept_.push_back(reference);
    } else {
      Py_DECREF(reference);  // True and False are never freed
      if (reference != Py_True) return false;
      keep(object);
    }
    if (is_negative(kept_.back())) {  // memory holds the negated values, as for x.conj().imag
      PyObject* const resolved = type.constant ? PyObject_CallMethodNoArgs(kept_.back(), resolve_word) : nullptr;
      if (resolved == nullptr) return PyErr_Clear(), false;
      Py_DECREF(std::exchange(kept_.back(), resolved));
    }
    PyObject* const number = PyObject_CallMethodNoArgs(kept_.back(), address_word);
    if (number == nullptr) return PyErr_Clear(), false;
    void* const pointer = PyLong_AsVoidPtr(number);
    Py_DECREF(number);
    if (pointer == nullptr && holds_entries(kept_.back())) return false;  // freed, as by storage.resize_
    address = pointer == nullptr ? TensorView::nothing() : pointer;
    if (recording() != nullptr && add_tensor(*recording(), kept_.back())) has_rows_ = true;
    return true;
  }

  static bool holds_entries(PyObject* tensor) {
    PyObject* const count = PyObject_CallMethod(tensor, "numel", nullptr);
    const bool holds = count == nullptr || PyLong_AsLongLong(count) != 0;
    PyErr_Clear();
    Py_XDECREF(count);
    return holds;
  }

  template <typename Resize>
  bool load_sequence(const Type& type, PyObject* object, const Resize& resize) {
    PyObject* const items = PySequence_Fast(object, "");
    if (items == nullptr) return PyErr_Clear(), false;
    kept_.push_back(items);
    const Py_ssize_t count = PySequence_Fast_GET_SIZE(items);
    char* const data = static_cast<char*>(static_cast<void*>(resize(static_cast<size_t>(count))));
    for (Py_ssize_t i = 0; i < count; ++i) {
      void* place = data + i * static_cast<Py_ssize_t>(type.size);
      if (!load(type, PySequence_Fast_GET_ITEM(items, i), place)) return false;
    }
    return true;
  }

  bool load_structure(const Type& type, PyObject* object, char* place) {
    if (!is_one(type, object)) return false;
    for (size_t i = 0; i < type.members.size(); ++i) {
      const Member& member = type.members[i];
      void* at = place + member.offset;
      if (load(*member.type, PyTuple_GET_ITEM(object, static_cast<Py_ssize_t>(i)), at)) continue;
      throw py::type_error(type.exact + ": " + member.name + " is not of type " + member.type->exact);
    }
    return true;
  }

  // Returns whether the object is a named tuple with the type's members.
  static bool is_one(const Type& type, PyObject* object) {
    if (!has_entries(object, type.members.size())) return false;
    if (Py_TYPE(object) == type.known_class) return true;
    PyObject* const names = PyObject_GetAttrString(object, "_fields");
    if (names == nullptr) return PyErr_Clear(), false;
    bool same = has_entries(names, type.members.size());
    for (size_t i = 0; same && i < type.members.size(); ++i) {
      PyObject* const name = PyTuple_GET_ITEM(names, static_cast<Py_ssize_t>(i));
      same = PyUnicode_Check(name) && PyUnicode_CompareWithASCIIString(name, type.members[i].name.c_str()) == 0;
    }
    Py_DECREF(names);
    if (!same) return false;
    Py_INCREF(Py_TYPE(object));
    type.known_class = Py_TYPE(object);
    return true;
  }

  std::vector<PyObject*> kept_;
  std::list<std::vector<void*>> arrays_;
  std::vector<Counted> counted_;
  bool has_rows_ = false;  // a tensor has counted rows
};

// The values of a call's parameters, constructed as they are loaded.
class Values {
 public:
  Values() = default;
  Values(const Values&) = delete;
  Values& operator=(const Values&) = delete;
  ~Values() {
    for (size_t i = 0; i < count_; ++i) {
      if (types_[i]->construct != nullptr) types_[i]->destroy(begins_[i]);
    }
  }
  // Constructs the next value and returns its address.
  void*& place(const Type& type) {
    void*& begin = begins_[count_];
    begin = memory_ + used_;
    used_ += (type.size + alignof(std::max_align_t) - 1) / alignof(std::max_align_t) * alignof(std::max_align_t);
    if (type.construct != nullptr) type.construct(begin);
    types_[count_] = &type;
    places_[count_] = begin;
    return places_[count_++];
  }
  bool load(Frame& frame, const Type& type, PyObject* given) { return frame.load(type, given, place(type)); }
  void* const* places() const { return places_; }
  void replace(size_t i, void* place) { places_[i] = place; }

 private:
  alignas(std::max_align_t) char memory_[kMostBytes];
  void *begins_[kMostParameters], *places_[kMostParameters];
  const Type* types_[kMostParameters];
  size_t count_ = 0, used_ = 0;
};

// A call with its loaded arguments.
struct Loaded {
  const Function* function;
  const Bound* bound;
  Frame frame;
  Values values;
};

// Runs the call and returns its result. The GIL is released if the function has a machine.
py::object run(Loaded& loaded);

}  // namespace voronerf
