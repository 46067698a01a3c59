// Calls from Python of what the binding files list, without templates and without a library: Python's own interface.
#include "bindings/bind.h"

#include <Python.h>

#include <algorithm>
#include <cstring>
#include <deque>
#include <exception>
#include <map>
#include <stdexcept>

#include "common/cuda_device.h"

namespace voronerf {

namespace {

constexpr size_t kMostParameters = 24;
constexpr size_t kMostBytes = 2048;  // of all parameters of a call

struct Bound {
  Module::AnyFunction function;
  Module::Call call;
  std::vector<const Type*> given;       // by Python
  std::vector<const Type*> parameters;  // of the function
  const Type *result, *machine;         // null: none
};

struct Function {
  std::string name;
  std::vector<Bound> overloads;
  PyMethodDef definition;
};

std::map<std::string, Function>& functions() {
  static std::map<std::string, Function> all;
  return all;
}

// Objects that Python has for dtypes, by the names of load.h.
std::map<std::string, PyObject*>& dtypes() {
  static std::map<std::string, PyObject*> known;
  return known;
}

// What a call has taken from Python, given back when it ends.
class Frame {
 public:
  Frame() = default;
  Frame(const Frame&) = delete;
  Frame& operator=(const Frame&) = delete;
  ~Frame() {
    for (PyObject* each : kept_) Py_DECREF(each);
  }

  // False: not of that type, with Python's error set where no other overload is to be tried. `place` becomes that of an
  // opaque object itself.
  bool load(const Type& type, PyObject* given, void*& place) {
    switch (type.kind) {
      case Type::Kind::boolean:
        if (!PyBool_Check(given)) return false;
        *static_cast<bool*>(place) = given == Py_True;
        return true;
      case Type::Kind::integer: {
        if (!PyLong_Check(given)) return false;
        const auto value =
            type.is_signed ? PyLong_AsLongLong(given) : static_cast<long long>(PyLong_AsUnsignedLongLong(given));
        if (value == -1 && PyErr_Occurred() != nullptr) return PyErr_Clear(), false;
        store(place, value, type.size);
        return true;
      }
      case Type::Kind::floating: {
        if (!PyFloat_Check(given) && !PyLong_Check(given)) return false;
        const double value = PyFloat_AsDouble(given);
        if (type.size == sizeof(float)) {
          *static_cast<float*>(place) = static_cast<float>(value);
        } else {
          *static_cast<double*>(place) = value;
        }
        return true;
      }
      case Type::Kind::enumeration:
        if (!PyUnicode_Check(given)) return false;
        for (size_t i = 0; i < type.values.size(); ++i) {
          if (PyUnicode_CompareWithASCIIString(given, type.values[i].c_str()) != 0) continue;
          store(place, static_cast<long long>(i), type.size);
          return true;
        }
        return false;
      case Type::Kind::tensor:
        return load_tensor(type, given, *static_cast<void**>(place));
      case Type::Kind::tensors:
        *static_cast<void***>(place) = nullptr;
        if (given == Py_None) return true;
        arrays_.emplace_back();
        return load_sequence(*type.of, given, [&](size_t count) {
          arrays_.back().resize(count + 1);
          *static_cast<void***>(place) = arrays_.back().data();
          return arrays_.back().data();
        });
      case Type::Kind::sequence:
        return load_sequence(*type.of, given, [&](size_t count) { return type.resize(place, count); });
      case Type::Kind::structure:
        return load_structure(type, given, static_cast<char*>(place));
      case Type::Kind::opaque:
        if (!PyCapsule_IsValid(given, type.exact.c_str())) return false;
        place = PyCapsule_GetPointer(given, type.exact.c_str());
        return true;
      default:
        return false;
    }
  }

 private:
  static void store(void* place, long long value, size_t size) { std::memcpy(place, &value, size); }

  // Tensors: anything with a dtype, contiguous(), is_contiguous(), is_neg(), resolve_neg() and data_ptr().
  bool load_tensor(const Type& type, PyObject* given, void*& address) {
    address = nullptr;
    if (given == Py_None) return true;
    static PyObject *const dtype_word = PyUnicode_InternFromString("dtype"),
                           *const address_word = PyUnicode_InternFromString("data_ptr"),
                           *const negative_word = PyUnicode_InternFromString("is_neg"),
                           *const resolve_word = PyUnicode_InternFromString("resolve_neg"),
                           *const contiguous_word = PyUnicode_InternFromString("contiguous"),
                           *const is_contiguous_word = PyUnicode_InternFromString("is_contiguous");
    if (type.dtype != "any") {
      if (type.known_dtype == nullptr) type.known_dtype = dtypes().at(type.dtype);
      PyObject* const dtype = PyObject_GetAttr(given, dtype_word);
      Py_XDECREF(dtype);  // a dtype lives as long as Python
      if (dtype != type.known_dtype) return PyErr_Clear(), false;
    }
    PyObject* const answer = PyObject_CallMethodNoArgs(given, type.constant ? contiguous_word : is_contiguous_word);
    if (answer == nullptr) return PyErr_Clear(), false;
    if (type.constant) {
      kept_.push_back(answer);
    } else {
      Py_DECREF(answer);  // True or False
      if (answer != Py_True) return false;
      Py_INCREF(given);
      kept_.push_back(given);
    }
    PyObject* const negative = PyObject_CallMethodNoArgs(kept_.back(), negative_word);
    if (negative == nullptr) return PyErr_Clear(), false;
    Py_DECREF(negative);        // True or False
    if (negative == Py_True) {  // memory holds the values negated, as of x.conj().imag
      PyObject* const resolved = type.constant ? PyObject_CallMethodNoArgs(kept_.back(), resolve_word) : nullptr;
      if (resolved == nullptr) return PyErr_Clear(), false;
      Py_DECREF(std::exchange(kept_.back(), resolved));
    }
    PyObject* const number = PyObject_CallMethodNoArgs(kept_.back(), address_word);
    if (number == nullptr) return PyErr_Clear(), false;
    void* const found = PyLong_AsVoidPtr(number);
    Py_DECREF(number);
    alignas(64) static char nothing[64];
    address = found == nullptr ? nothing : found;
    return true;
  }

  template <typename Resize>
  bool load_sequence(const Type& type, PyObject* given, const Resize& resize) {
    PyObject* const items = PySequence_Fast(given, "");
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

  bool load_structure(const Type& type, PyObject* given, char* place) {
    if (!is_one(type, given)) return false;
    for (size_t i = 0; i < type.members.size(); ++i) {
      const Member& member = type.members[i];
      void* at = place + member.offset;
      if (load(*member.type, PyTuple_GET_ITEM(given, static_cast<Py_ssize_t>(i)), at)) continue;
      if (PyErr_Occurred() == nullptr) {
        PyErr_Format(PyExc_TypeError, "%s: %s is no %s", type.exact.c_str(), member.name.c_str(),
                     member.type->exact.c_str());
      }
      return false;
    }
    return true;
  }

  // A named tuple of these members.
  static bool is_one(const Type& type, PyObject* given) {
    if (Py_TYPE(given) == type.known_class) return true;
    if (!PyTuple_Check(given)) return false;
    PyObject* const names = PyObject_GetAttrString(given, "_fields");
    if (names == nullptr) return PyErr_Clear(), false;
    bool same = PyTuple_Check(names) && PyTuple_GET_SIZE(names) == static_cast<Py_ssize_t>(type.members.size());
    for (size_t i = 0; same && i < type.members.size(); ++i) {
      PyObject* const name = PyTuple_GET_ITEM(names, static_cast<Py_ssize_t>(i));
      same = PyUnicode_Check(name) && PyUnicode_CompareWithASCIIString(name, type.members[i].name.c_str()) == 0;
    }
    Py_DECREF(names);
    if (!same) return false;
    Py_INCREF(Py_TYPE(given));
    type.known_class = Py_TYPE(given);
    return true;
  }

  std::vector<PyObject*> kept_;
  std::deque<std::vector<void*>> arrays_;
};

// Values of parameters, made when they are loaded.
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
  bool load(Frame& frame, const Type& type, PyObject* given) {
    void*& begin = begins_[count_];
    begin = memory_ + used_;
    used_ += (type.size + alignof(std::max_align_t) - 1) / alignof(std::max_align_t) * alignof(std::max_align_t);
    if (type.construct != nullptr) type.construct(begin);
    types_[count_] = &type;
    places_[count_] = begin;
    return frame.load(type, given, places_[count_++]);
  }
  void* const* places() const { return places_; }
  void replace(size_t i, void* place) { places_[i] = place; }

 private:
  alignas(std::max_align_t) char memory_[kMostBytes];
  void *begins_[kMostParameters], *places_[kMostParameters];
  const Type* types_[kMostParameters];
  size_t count_ = 0, used_ = 0;
};

void set_error(std::exception_ptr thrown) {
  try {
    std::rethrow_exception(thrown);
  } catch (const std::bad_alloc&) {
    PyErr_NoMemory();
  } catch (const std::invalid_argument& fault) {
    PyErr_SetString(PyExc_ValueError, fault.what());
  } catch (const std::out_of_range& fault) {
    PyErr_SetString(PyExc_IndexError, fault.what());
  } catch (const std::exception& fault) {
    PyErr_SetString(PyExc_RuntimeError, fault.what());
  }
}

union Result {
  bool boolean;
  long long integer;
  float single;
  double real;
  const char* text;
  void* object;
};

PyObject* to_python(const Type* type, const Result& result) {
  if (type == nullptr) Py_RETURN_NONE;
  switch (type->kind) {
    case Type::Kind::boolean:
      return PyBool_FromLong(result.boolean);
    case Type::Kind::integer:
      return PyLong_FromLongLong(type->size == 4 ? static_cast<int32_t>(result.integer) : result.integer);
    case Type::Kind::floating:
      return PyFloat_FromDouble(type->size == 4 ? static_cast<double>(result.single) : result.real);
    case Type::Kind::text:
      if (result.text == nullptr) Py_RETURN_NONE;
      return PyUnicode_FromString(result.text);
    default:
      return PyCapsule_New(result.object, type->exact.c_str(), [](PyObject* capsule) {
        const char* name = PyCapsule_GetName(capsule);
        static_cast<const Type*>(PyCapsule_GetContext(capsule))->destroy(PyCapsule_GetPointer(capsule, name));
      });
  }
}

PyObject* run(const Bound& bound, Values& values) {
  void* stream = nullptr;
  int device = 0;
  const size_t own = bound.given.size() - (bound.machine != nullptr);
  if (bound.machine == &type_of<Cpu>()) {
    auto& cpu = *static_cast<Cpu*>(values.places()[own]);
    values.replace(bound.parameters.size() - 1, &cpu.threads);
    if (bound.parameters.size() == own + 2) values.replace(own, &cpu.isa);
  } else if (bound.machine != nullptr) {
    const Cuda& cuda = *static_cast<const Cuda*>(values.places()[own]);
    device = cuda.device;
    stream = reinterpret_cast<void*>(cuda.stream);
    values.replace(own, &stream);
  }
  Result result{};
  std::exception_ptr thrown;
  PyThreadState* const state = bound.machine != nullptr ? PyEval_SaveThread() : nullptr;
  try {
#ifdef VN_WITH_CUDA
    std::unique_ptr<CudaDevice> current;
    if (bound.machine == &type_of<Cuda>()) current = std::make_unique<CudaDevice>(device);
#else
    static_cast<void>(device);
#endif
    bound.call(bound.function, values.places(), &result);
  } catch (...) {
    thrown = std::current_exception();
  }
  if (state != nullptr) PyEval_RestoreThread(state);
  if (thrown) return set_error(thrown), nullptr;
  PyObject* const python = to_python(bound.result, result);
  if (python != nullptr && bound.result != nullptr && bound.result->kind == Type::Kind::opaque) {
    PyCapsule_SetContext(python, const_cast<Type*>(bound.result));
  }
  return python;
}

PyObject* call_any(PyObject* self, PyObject* const* given, Py_ssize_t count) {
  const Function& function = *static_cast<const Function*>(PyCapsule_GetPointer(self, nullptr));
  try {
    for (const Bound& bound : function.overloads) {
      if (bound.function == nullptr || bound.given.size() != static_cast<size_t>(count)) continue;
      Frame frame;
      Values values;
      bool fits = true;
      for (Py_ssize_t i = 0; fits && i < count; ++i) {
        fits = values.load(frame, *bound.given[static_cast<size_t>(i)], given[i]);
      }
      if (fits) return run(bound, values);
      if (PyErr_Occurred() != nullptr) return nullptr;
    }
  } catch (...) {
    return set_error(std::current_exception()), nullptr;
  }
  PyErr_Format(PyExc_TypeError, "%s: incompatible function arguments", function.name.c_str());
  return nullptr;
}

PyObject* name_dtypes(PyObject*, PyObject* names) {
  PyObject *key = nullptr, *value = nullptr;
  for (Py_ssize_t at = 0; PyDict_Next(names, &at, &key, &value) != 0;) {
    Py_INCREF(value);
    dtypes()[PyUnicode_AsUTF8(key)] = value;
  }
  Py_RETURN_NONE;
}

// CRC-32 as in zlib.
uint32_t checksum(const std::string& text) {
  uint32_t sum = ~0u;
  for (const char letter : text) {
    sum ^= static_cast<unsigned char>(letter);
    for (int bit = 0; bit < 8; ++bit) sum = sum >> 1 ^ ((sum & 1) != 0 ? 0xEDB88320u : 0u);
  }
  return ~sum;
}

constexpr const char* kStub =
    "# The compiled module, written by its build from what csrc/bindings binds; the checksum is its interface.\n"
    "# A comment has the exact types of the C++ function, whose parameters these are. A tensor is contiguous, or "
    "becomes\n"
    "# so where it is const; None is a null pointer.\n"
    "from collections.abc import Sequence\n"
    "from typing import NamedTuple, overload\n"
    "\n"
    "import torch\n"
    "from torch import Tensor\n"
    "\n"
    "interface: int\n"
    "stub: str\n"
    "compiler: str\n"
    "openmp: bool\n"
    "cuda: bool\n"
    "cuda_outcome: str\n"
    "cuda_architectures: str\n"
    "cuda_major: int\n"
    "\n"
    "def name_dtypes(names: dict[str, torch.dtype]) -> None: ...\n";

// What is bound, as a stub for type checkers (voronerf/ops/_core/_C.pyi), and the classes that it needs.
class Declarations {
 public:
  explicit Declarations(PyObject* module) : module_(module) {}

  void declare(const Type& type) {
    if (type.of != nullptr) declare(*type.of);
    if (type.kind == Type::Kind::opaque) {
      texts_[type.exact] = "class " + type.exact + ": ...\n";
    } else if (type.kind == Type::Kind::enumeration && texts_.count(type.exact) == 0) {
      std::string names;
      for (const std::string& value : type.values) names += (names.empty() ? "" : " ") + value;
      texts_[type.exact] = type.exact + ": tuple[str, ...]  # " + names + "\n";
      add(type.exact, tuple_of(type.values));
    } else if (type.kind == Type::Kind::structure && texts_.count(type.exact) == 0) {
      std::string& text = texts_[type.exact] = "class " + type.exact + "(NamedTuple):\n";
      std::vector<std::string> names;
      for (const Member& member : type.members) {
        declare(*member.type);
        const std::string &python = member.type->python, &exact = member.type->exact;
        text += "    " + member.name + ": " + python + (python == exact ? "\n" : "  # " + exact + "\n");
        names.push_back(member.name);
      }
      PyObject* const collections = PyImport_ImportModule("collections");
      PyObject* const fields = tuple_of(names);
      add(type.exact, PyObject_CallMethod(collections, "namedtuple", "sO", type.exact.c_str(), fields));
      Py_DECREF(fields);
      Py_DECREF(collections);
    }
  }

  void declare(const Function& function) {
    std::vector<std::string> lines;
    text_ += "\n";
    for (const Bound& bound : function.overloads) {
      std::string line = "def " + function.name + "(";
      for (size_t i = 0; i < bound.given.size(); ++i) {
        declare(*bound.given[i]);
        line += (i == 0 ? "_" : ", _") + std::to_string(i) + ": " + bound.given[i]->python;
      }
      if (bound.result != nullptr) declare(*bound.result);
      lines.push_back(line + ") -> " + (bound.result == nullptr ? "None" : bound.result->python) + ": ...\n");
    }
    const bool overloaded = std::count(lines.begin(), lines.end(), lines[0]) < static_cast<long>(lines.size());
    for (size_t i = 0; i < lines.size(); ++i) {
      std::string exact;
      for (const Type* each : function.overloads[i].given) exact += (exact.empty() ? "" : ", ") + each->exact;
      text_ += "# " + exact + "\n";
      if (std::find(lines.begin(), lines.end(), lines[i]) != lines.begin() + static_cast<long>(i)) continue;
      text_ += (overloaded ? "@overload\n" : "") + lines[i];
    }
  }

  std::string stub() const {
    std::string text = kStub;
    for (const auto& entry : texts_) text += "\n" + entry.second;
    return text + text_;
  }

  // Steals the value.
  void add(const std::string& name, PyObject* value) {
    if (value == nullptr || PyModule_AddObject(module_, name.c_str(), value) != 0) throw std::runtime_error(name);
  }

 private:
  static PyObject* tuple_of(const std::vector<std::string>& texts) {
    PyObject* const tuple = PyTuple_New(static_cast<Py_ssize_t>(texts.size()));
    for (size_t i = 0; i < texts.size(); ++i) {
      PyTuple_SET_ITEM(tuple, static_cast<Py_ssize_t>(i), PyUnicode_FromString(texts[i].c_str()));
    }
    return tuple;
  }

  PyObject* module_;
  std::map<std::string, std::string> texts_;
  std::string text_;
};

}  // namespace

void Module::add(const char* name, AnyFunction function, Call call, std::vector<const Type*> parameters,
                 const Type* result, const Type* machine) {
  std::vector<const Type*> given = parameters;
  if (machine != nullptr) {
    const bool two = given.size() > 1 && given[given.size() - 2] == &type_of<Isa>();
    if (machine == &type_of<Cpu>()) given.resize(given.size() - (two ? 2 : 1));
    if (machine == &type_of<Cuda>() && given.back() == &type_of<void*>()) given.pop_back();
    given.push_back(machine);
  }
  size_t bytes = 0;
  for (const Type* type : given) bytes += type->size + alignof(std::max_align_t);
  if (bytes > kMostBytes || given.size() >= kMostParameters) throw std::logic_error(name);
  Function& all = functions()[name];
  all.name = name;
  all.overloads.push_back({function, call, std::move(given), std::move(parameters), result, machine});
}

void load_struct(const Type& type, PyObject* given, void* place) {
  Frame frame;
  if (!frame.load(type, given, place)) throw std::invalid_argument(type.exact);
}

bool bind_all(PyObject* python) {
  try {
    Module module;
    for (const auto bind : bindings()) bind(module);
    Declarations declarations(python);
    for (auto& [name, function] : functions()) {
      declarations.declare(function);
      bool there = false;
      for (const Bound& bound : function.overloads) there = there || bound.function != nullptr;
      if (!there) continue;
      PyObject* const self = PyCapsule_New(&function, nullptr, nullptr);
      const auto entry = reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(&call_any));
      function.definition = {name.c_str(), entry, METH_FASTCALL, nullptr};
      declarations.add(name, PyCFunction_New(&function.definition, self));
      Py_DECREF(self);
    }
    static PyMethodDef naming = {"name_dtypes", &name_dtypes, METH_O, nullptr};
    declarations.add("name_dtypes", PyCFunction_New(&naming, nullptr));
    const std::string text = declarations.stub();
    declarations.add("stub", PyUnicode_FromString(text.c_str()));
    declarations.add("interface", PyLong_FromUnsignedLong(checksum(text)));
    return true;
  } catch (...) {
    return set_error(std::current_exception()), false;
  }
}

}  // namespace voronerf
