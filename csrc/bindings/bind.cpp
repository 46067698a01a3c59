// Calls from Python of what the binding files list: the only file that reads pybind11.
#include "bindings/bind.h"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cstring>
#include <deque>
#include <map>
#include <optional>
#include <set>
#include <stdexcept>

#include "common/cuda_device.h"
#include "common/parallel.h"
#include "common/trace.h"

namespace voronerf {

namespace py = pybind11;

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

class Recording;
Recording*& recorded() {  // the one that the calling thread's calls are added to, or null
  static thread_local Recording* recording = nullptr;
  return recording;
}
void refuse(Recording& recording, const std::string& why);
bool add_tensor(Recording& recording, PyObject* tensor);

// What a call has taken from Python, given back when it ends.
class Frame {
 public:
  // A number of rows that a recorded call has taken, where it lies, less so many, and the most that it may be.
  struct Counted {
    RowCount* rows;
    const int64_t* memory;
    int64_t more, most;
  };
  Frame() = default;
  Frame(const Frame&) = delete;
  Frame& operator=(const Frame&) = delete;
  ~Frame() {
    for (PyObject* each : kept_) Py_DECREF(each);
  }

  const std::vector<Counted>& counted() const { return counted_; }
  bool misses_rows() const { return has_rows_ && counted_.empty(); }

  // False: not of that type. `place` becomes that of an opaque object itself.
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
      case Type::Kind::rows: {
        if (!PyLong_Check(given)) return false;
        const int64_t rows = PyLong_AsLongLong(given);
        if (rows == -1 && PyErr_Occurred() != nullptr) return PyErr_Clear(), false;
        *static_cast<RowCount*>(place) = rows;
        if (recorded() != nullptr && rows != 0) count(given, *static_cast<RowCount*>(place));
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
      case Type::Kind::text:
        if (!PyUnicode_Check(given)) return false;
        *static_cast<const char**>(place) = PyUnicode_AsUTF8(given);
        keep(given);  // which owns the characters
        return *static_cast<const char**>(place) != nullptr;
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
        keep(given);
        return true;
      default:
        return false;
    }
  }

 private:
  static void store(void* place, long long value, size_t size) { std::memcpy(place, &value, size); }

  void keep(PyObject* given) {
    Py_INCREF(given);
    kept_.push_back(given);
  }

  // A RowCount of voronerf/ops/_core/rows.py, which is an int too.
  void count(PyObject* given, RowCount& rows) {
    if (PyLong_CheckExact(given)) {
      return refuse(*recorded(), "a number of rows lies in no memory, " + std::to_string(rows.value));
    }
    const auto number = [given](const char* name) { return py::cast<int64_t>(py::handle(given).attr(name)); };
    const auto* memory = reinterpret_cast<const int64_t*>(py::cast<std::uintptr_t>(py::handle(given).attr("address")));
    counted_.push_back({&rows, memory, number("more"), number("most")});
    keep(given);  // which holds the memory
  }

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
    if (answer == nullptr) throw py::error_already_set();  // no memory
    if (type.constant) {
      kept_.push_back(answer);
    } else {
      Py_DECREF(answer);  // True or False
      if (answer != Py_True) return false;
      keep(given);
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
    if (found == nullptr && holds_entries(kept_.back())) return false;  // memory that was freed, as by storage.resize_
    alignas(64) static char nothing[64];
    address = found == nullptr ? nothing : found;
    if (recorded() != nullptr && add_tensor(*recorded(), kept_.back())) has_rows_ = true;
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
      throw py::type_error(type.exact + ": " + member.name + " is no " + member.type->exact);
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
  std::vector<Counted> counted_;
  bool has_rows_ = false;  // a tensor whose rows are counted
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

union Result {
  bool boolean;
  long long integer;
  float single;
  double real;
  const char* text;
  void* object;
};

py::object to_python(const Type* type, const Result& result) {
  if (type == nullptr) return py::none();
  switch (type->kind) {
    case Type::Kind::boolean:
      return py::bool_(result.boolean);
    case Type::Kind::integer:
      return py::int_(type->size == 4 ? static_cast<int32_t>(result.integer) : result.integer);
    case Type::Kind::floating:
      return py::float_(type->size == 4 ? static_cast<double>(result.single) : result.real);
    case Type::Kind::text:
      if (result.text == nullptr) return py::none();
      return py::str(result.text);
    default: {
      py::capsule owner(result.object, type->destroy);
      owner.set_name(type->exact.c_str());
      return std::move(owner);
    }
  }
}

// A call with what it has taken.
struct Loaded {
  const Function* function;
  const Bound* bound;
  Frame frame;
  Values values;
};

// A call that was traced (common/trace.h).
struct Traced {
  const std::string* name;
  double seconds;
  Trace regions;
};
bool tracing = false;
std::vector<Traced> traced_calls;

// Without the GIL.
void call(const Loaded& loaded, Result& result) {
  Trace regions;
  if (tracing) trace = &regions;
  const double began = tracing ? Trace::now() : 0.0;
  loaded.bound->call(loaded.bound->function, loaded.values.places(), &result);
  if (tracing) {
    trace = nullptr;
    traced_calls.push_back({&loaded.function->name, Trace::now() - began, regions});
  }
}

// Where a tensor's memory is and, with its layout, how it lies there; null without an answer. That it is contiguous
// takes half the time to find that its size and stride take.
struct Place {
  py::object answers[3];

  Place(PyObject* tensor, bool layout, bool contiguous) {
    static PyObject* const methods[] = {PyUnicode_InternFromString("data_ptr"), PyUnicode_InternFromString("size"),
                                        PyUnicode_InternFromString("stride"), PyUnicode_InternFromString("numel"),
                                        PyUnicode_InternFromString("is_contiguous")};
    for (int i = 0; i < (layout ? 3 : 1); ++i) {
      PyObject* const method = methods[i + (i > 0 && contiguous ? 2 : 0)];
      answers[i] = py::reinterpret_steal<py::object>(PyObject_CallMethodNoArgs(tensor, method));
    }
    PyErr_Clear();
  }
  bool operator==(const Place& other) const {
    for (int i = 0; i < 3; ++i) {
      PyObject *const one = answers[i].ptr(), *const two = other.answers[i].ptr();
      if (one == nullptr && two == nullptr) continue;
      if (one == nullptr || two == nullptr || PyObject_RichCompareBool(one, two, Py_EQ) != 1)
        return PyErr_Clear(), false;
    }
    return true;
  }
};

// Members of dictionaries that must stay the same objects, but for those of the keys `free`, and tensors that must stay
// where and as they are. Their storages are held too: memory that a tensor has left (`x.data = y`) is not freed.
class Guards {
 public:
  void add(const py::dict& members, const std::vector<std::string>& free) {
    Guard guard{members, {}};
    for (const auto& [key, value] : members) {
      const bool any =
          py::isinstance<py::str>(key) && std::count(free.begin(), free.end(), py::cast<std::string>(key)) != 0;
      guard.values.push_back(any ? py::object() : py::reinterpret_borrow<py::object>(value));
    }
    guards_.push_back(std::move(guard));
  }
  void add_tensor(const py::object& tensor, bool layout) {
    if (!known_.insert(tensor.ptr()).second) return;
    const bool contiguous = py::cast<bool>(tensor.attr("is_contiguous")());
    const Place place(tensor.ptr(), layout, contiguous);
    tensors_.push_back({tensor, tensor.attr("untyped_storage")(), place, layout, contiguous});
  }
  // Compares as little as may be: between the kernels of a loop, whatever is looked at must come from memory.
  bool hold() const {
    for (const Guard& guard : guards_) {
      size_t i = 0;
      PyObject *key, *value;
      for (Py_ssize_t place = 0; PyDict_Next(guard.members.ptr(), &place, &key, &value) != 0; ++i) {
        if (i == guard.values.size()) return false;
        if (guard.values[i] && guard.values[i].ptr() != value) return false;
      }
      if (i != guard.values.size()) return false;
    }
    return std::all_of(tensors_.begin(), tensors_.end(), [](const Held& held) {
      return Place(held.tensor.ptr(), held.layout, held.contiguous) == held.place;
    });
  }

 private:
  struct Guard {
    py::dict members;
    std::vector<py::object> values;  // null for any
  };
  struct Held {
    py::object tensor, storage;
    Place place;
    bool layout, contiguous;
  };
  std::vector<Guard> guards_;
  std::vector<Held> tensors_;
  std::set<PyObject*> known_;  // the tensors
};

// Calls of a step in their order, with what they have taken, to be made again on the same memory, which is held. A
// number of rows is read again from where it lies, so the memory must do for the most rows.
class Recording {
 public:
  // Calls of this thread are added from here to `end`.
  void begin() { recorded() = this; }
  void end() { recorded() = nullptr; }

  // A tensor that a call takes, or of which such a tensor is a view. What is made for the calls stays where it is.
  // Gives whether its rows are counted.
  bool add_tensor(const py::object& tensor) {
    const auto found = made_.find(py::cast<std::uintptr_t>(tensor.attr("untyped_storage")().attr("data_ptr")()));
    if (found != made_.end()) return found->second;
    tensors_.add_tensor(tensor, true);
    return false;
  }
  // One that was made for the calls, and that others hold too.
  void hold_tensor(const py::object& tensor) { tensors_.add_tensor(tensor, false); }
  // The storage at an address is memory for these calls, or for others that are made before; of counted rows, or not.
  void made(std::uintptr_t address, bool counted) { made_[address] = counted; }
  bool hold() const { return tensors_.hold(); }
  void add(std::unique_ptr<Loaded> loaded) {
    if (loaded->bound->machine != &type_of<Cpu>()) refuse(loaded->function->name + " runs on a device");
    if (loaded->frame.misses_rows()) refuse(loaded->function->name + " takes no number of rows that is counted");
    calls_.push_back(std::move(loaded));
  }

  // Makes the calls from `first` to `last` again, so many times in a row. Before each time the next random numbers,
  // `bytes` for each of `places`, are copied there. Gives how often they were made: it ends before a call that would
  // exceed its memory. With a trace they have no team.
  int replay(int threads, int times, size_t first, size_t last, std::uintptr_t drawn,
             const std::vector<std::uintptr_t>& places, size_t bytes) {
    const py::gil_scoped_release released;
    int made = 0;
    std::exception_ptr failure;
    with_team(tracing ? 1 : threads, [&] {
      try {
        for (; made < times; ++made) {
          for (const std::uintptr_t place : places) {
            std::memcpy(reinterpret_cast<void*>(place), reinterpret_cast<const void*>(drawn), bytes);
            drawn += bytes;
          }
          for (size_t i = first; i < last; ++i) {
            if (!again(*calls_.at(i))) return;
          }
        }
      } catch (...) {
        failure = std::current_exception();
      }
    });
    if (failure) std::rethrow_exception(failure);
    return made;
  }

  void refuse(const std::string& why) {
    if (obstacle_.empty()) obstacle_ = why;
  }
  size_t size() const { return calls_.size(); }
  const std::string& obstacle() const { return obstacle_; }

 private:
  static bool again(const Loaded& loaded) {
    for (const auto& [rows, memory, more, most] : loaded.frame.counted()) {
      if (*memory > most) return false;
      *rows = *memory + more;
    }
    Result result{};
    call(loaded, result);
    const Type* type = loaded.bound->result;
    if (type != nullptr && type->kind == Type::Kind::boolean && !result.boolean) {
      throw std::invalid_argument(loaded.function->name + ": indices out of range");
    }
    return true;
  }

  std::vector<std::unique_ptr<Loaded>> calls_;
  std::string obstacle_;
  Guards tensors_;
  std::map<std::uintptr_t, bool> made_;
};

void refuse(Recording& recording, const std::string& why) { recording.refuse(why); }
bool add_tensor(Recording& recording, PyObject* tensor) {
  return recording.add_tensor(py::reinterpret_borrow<py::object>(tensor));
}

py::object run(Loaded& loaded) {
  const Bound& bound = *loaded.bound;
  Values& values = loaded.values;
  void* stream = nullptr;
  [[maybe_unused]] int device = 0;
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
  {
    std::optional<py::gil_scoped_release> released;
    if (bound.machine != nullptr) released.emplace();
#ifdef VN_WITH_CUDA
    std::optional<CudaDevice> current;
    if (bound.machine == &type_of<Cuda>()) current.emplace(device);
#endif
    call(loaded, result);
  }
  return to_python(bound.result, result);
}

// Whether all arguments are of the types that a function takes.
bool load(Loaded& loaded, const py::args& given) {
  for (size_t i = 0; i < given.size(); ++i) {
    PyObject* const argument = PyTuple_GET_ITEM(given.ptr(), static_cast<Py_ssize_t>(i));
    if (!loaded.values.load(loaded.frame, *loaded.bound->given[i], argument)) return false;
  }
  return true;
}

py::object call_any(const Function& function, const py::args& given) {
  for (const Bound& bound : function.overloads) {
    if (bound.function == nullptr || bound.given.size() != given.size()) continue;
    if (recorded() == nullptr || bound.machine == nullptr) {
      Loaded loaded{&function, &bound, {}, {}};
      if (load(loaded, given)) return run(loaded);
    } else {
      auto loaded = std::unique_ptr<Loaded>(new Loaded{&function, &bound, {}, {}});
      if (!load(*loaded, given)) continue;
      py::object result = run(*loaded);
      if (recorded() != nullptr) recorded()->add(std::move(loaded));
      return result;
    }
  }
  throw py::type_error(function.name + ": incompatible function arguments");
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
    "from typing import Any, NamedTuple, overload\n"
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
    "most_sources: int\n"
    "\n"
    "class Guards:\n"
    "    def add(self, members: Any, free: Sequence[str]) -> None: ...\n"
    "    def add_tensor(self, tensor: Tensor, layout: bool) -> None: ...\n"
    "    def hold(self) -> bool: ...\n"
    "\n"
    "class Recording:\n"
    "    obstacle: str\n"
    "    def __len__(self) -> int: ...\n"
    "    def begin(self) -> None: ...\n"
    "    def end(self) -> None: ...\n"
    "    def add_tensor(self, tensor: Tensor) -> bool: ...\n"
    "    def hold_tensor(self, tensor: Tensor) -> None: ...\n"
    "    def made(self, address: int, counted: bool) -> None: ...\n"
    "    def hold(self) -> bool: ...\n"
    "    def replay(self, threads: int, times: int, first: int, last: int, drawn: int, places: Sequence[int],\n"
    "               bytes: int) -> int: ...\n"
    "\n"
    "def name_dtypes(names: dict[str, torch.dtype]) -> None: ...\n"
    "def trace(on: bool) -> list[tuple[str, float, int, float, list[float]]]: ...\n";

// What is bound, as a stub for type checkers (voronerf/ops/_core/_C.pyi), and the classes that it needs.
class Declarations {
 public:
  explicit Declarations(const py::module_& module) : module_(module) {}

  void declare(const Type& type) {
    if (type.of != nullptr) declare(*type.of);
    if (type.kind == Type::Kind::opaque) {
      texts_[type.exact] = "class " + type.exact + ": ...\n";
    } else if (type.kind == Type::Kind::enumeration && texts_.count(type.exact) == 0) {
      std::string names;
      for (const std::string& value : type.values) names += (names.empty() ? "" : " ") + value;
      texts_[type.exact] = type.exact + ": tuple[str, ...]  # " + names + "\n";
      module_.attr(type.exact.c_str()) = tuple_of(type.values);
    } else if (type.kind == Type::Kind::structure && texts_.count(type.exact) == 0) {
      std::string& text = texts_[type.exact] = "class " + type.exact + "(NamedTuple):\n";
      std::vector<std::string> names;
      for (const Member& member : type.members) {
        declare(*member.type);
        const std::string &python = member.type->python, &exact = member.type->exact;
        text += "    " + member.name + ": " + python + (python == exact ? "\n" : "  # " + exact + "\n");
        names.push_back(member.name);
      }
      module_.attr(type.exact.c_str()) =
          py::module_::import("collections").attr("namedtuple")(type.exact, tuple_of(names));
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

 private:
  static py::tuple tuple_of(const std::vector<std::string>& texts) {
    py::list all;
    for (const std::string& text : texts) all.append(text);
    return py::tuple(all);
  }

  py::module_ module_;
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

void bind_all(PyObject* python) {
  auto bound = py::reinterpret_borrow<py::module_>(python);
  Module module;
  for (const auto bind : bindings()) bind(module);
  Declarations declarations(bound);
  for (const auto& [name, function] : functions()) {
    declarations.declare(function);
    bool there = false;
    for (const Bound& one : function.overloads) there = there || one.function != nullptr;
    if (!there) continue;
    bound.def(name.c_str(), [one = &function](const py::args& given) { return call_any(*one, given); });
  }
  py::class_<Guards>(bound, "Guards")
      .def(py::init())
      .def("add", &Guards::add)
      .def("add_tensor", &Guards::add_tensor)
      .def("hold", &Guards::hold);
  py::class_<Recording>(bound, "Recording")
      .def(py::init())
      .def("begin", &Recording::begin)
      .def("end", &Recording::end)
      .def("add_tensor", &Recording::add_tensor)
      .def("hold_tensor", &Recording::hold_tensor)
      .def("made", &Recording::made)
      .def("hold", &Recording::hold)
      .def("replay", &Recording::replay)
      .def("__len__", &Recording::size)
      .def_property_readonly("obstacle", &Recording::obstacle);
  // The dtypes of tensors, objects of Python that this module knows by name alone.
  bound.def("name_dtypes", [](const py::dict& names) {
    for (const auto& entry : names) {
      dtypes()[py::cast<std::string>(entry.first)] = py::reinterpret_borrow<py::object>(entry.second).release().ptr();
    }
  });
  // Whether calls are traced from now on; of those before, name, seconds, regions, the seconds in these, and what they
  // would take on each number of Trace::kTeams.
  bound.def("trace", [](bool on) {
    tracing = on;
    py::list found;
    for (const Traced& call : std::exchange(traced_calls, {})) {
      py::list shared;
      for (const double seconds : call.regions.shared) shared.append(seconds);
      found.append(py::make_tuple(*call.name, call.seconds, call.regions.regions, call.regions.inside, shared));
    }
    return found;
  });
  const std::string text = declarations.stub();
  bound.attr("stub") = text;
  bound.attr("interface") = checksum(text);
}

}  // namespace voronerf
