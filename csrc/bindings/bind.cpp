// Calls from Python to the functions that the binding files list.
#include "bindings/bind.h"

#include <pybind11/stl.h>

#include <algorithm>
#include <optional>

#include "bindings/frame.h"
#include "bindings/program_call.h"
#include "bindings/signature.h"
#include "bindings/unchanged.h"
#include "common/cuda_device.h"
#include "common/parallel.h"

namespace voronerf {

namespace {

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

// Calls the C++ function. The caller may have released the GIL.
void call(const Loaded& loaded, Result& result) {
  loaded.bound->call(loaded.bound->function, loaded.values.places(), &result);
}

}  // namespace

// The calls of a step in order, with their arguments. They are replayed on the same memory, which the recording holds.
// Row counts are read again from memory at each replay, so tensors must be large enough for the largest row counts.
class Recording {
 public:
  // Calls of this thread between `begin` and `end` are added to the recording, which keeps itself alive.
  static void begin(const py::object& self) {
    if (recording() != nullptr) throw std::logic_error("another recording is active");
    recording() = py::cast<Recording*>(self);
    self.inc_ref();
  }
  static void end(const py::object& self) {
    if (recording() != py::cast<Recording*>(self)) return;
    recording() = nullptr;
    self.dec_ref();
  }

  // Adds a tensor argument of a call, or the base of a view. Replays check that the tensor is unchanged, unless a
  // recording allocated its memory. Returns whether its number of rows may vary between replays (RowCount).
  bool add_tensor(const py::object& tensor) {
    const auto found = made_.find(py::cast<std::uintptr_t>(tensor.attr("untyped_storage")().attr("data_ptr")()));
    if (found != made_.end()) return found->second;
    tensors_.layout(tensor);
    return false;
  }
  // Adds a tensor that this recording allocated. Replays check that its memory has not been replaced.
  void hold_tensor(const py::object& tensor) { tensors_.place(tensor); }
  // Registers a storage, by its address, as memory that this recording or an earlier one allocated. `counted`: whether
  // its number of rows may vary between replays (RowCount).
  void made(std::uintptr_t address, bool counted) { made_[address] = counted; }
  bool hold() const { return tensors_.holds(); }
  void add(std::unique_ptr<Loaded> loaded) {
    if (loaded->bound->machine != &type_of<Cpu>()) refuse(loaded->function->name + " runs on a device");
    if (loaded->frame.misses_rows()) refuse(loaded->function->name + " has no RowCount among its arguments");
    calls_.push_back(std::move(loaded));
  }

  // Replays the calls [first, last) `times` times in a row, on `threads` threads. Before each replay, each of `places`
  // receives the next `bytes` bytes of the random numbers at the address `drawn`. Returns the number of complete
  // replays: the replay stops before a call whose rows would exceed the memory of its tensors.
  int replay(int threads, int times, size_t first, size_t last, std::uintptr_t drawn,
             const std::vector<std::uintptr_t>& places, size_t bytes) {
    const py::gil_scoped_release released;
    int repeats = 0;
    std::exception_ptr failure;
    with_team(threads, [&] {
      try {
        for (; repeats < times; ++repeats) {
          for (const std::uintptr_t place : places) {
            std::memcpy(reinterpret_cast<void*>(place), reinterpret_cast<const void*>(drawn), bytes);
            drawn += bytes;
          }
          for (size_t i = first; i < last; ++i) {
            if (!replay_call(*calls_.at(i))) return;
          }
        }
      } catch (...) {
        failure = std::current_exception();
      }
    });
    if (failure) std::rethrow_exception(failure);
    return repeats;
  }

  void refuse(const std::string& why) {
    if (obstacle_.empty()) obstacle_ = why;
  }
  size_t size() const { return calls_.size(); }
  int each_held(const Visit& visit) const {
    int status = tensors_.each_held(visit);
    for (const auto& call : calls_) {
      for (PyObject* const object : call->frame.kept()) status = status != 0 ? status : visit(object);
    }
    return status;
  }
  void release() {
    calls_.clear();
    tensors_.release();
  }
  const std::string& obstacle() const { return obstacle_; }

 private:
  static bool replay_call(const Loaded& loaded) {
    for (const auto& [rows, memory, offset, capacity] : loaded.frame.counted()) {
      if (*memory > capacity) return false;
      *rows = *memory + offset;
    }
    Result result{};
    call(loaded, result);
    const Type* type = loaded.bound->result;
    if (type != nullptr && type->kind == Type::Kind::boolean && !result.boolean) {
      throw std::invalid_argument(loaded.function->name +
                                  ": arguments must be valid in a replay, got invalid indices or tables");
    }
    return true;
  }

  std::vector<std::unique_ptr<Loaded>> calls_;
  std::string obstacle_;
  Unchanged tensors_;
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

namespace {

// Loads the arguments of a call. Returns false if an argument does not have the type of its parameter.
bool load(Loaded& loaded, const py::args& arguments) {
  for (size_t i = 0; i < arguments.size(); ++i) {
    PyObject* const argument = PyTuple_GET_ITEM(arguments.ptr(), static_cast<Py_ssize_t>(i));
    if (!loaded.values.load(loaded.frame, *loaded.bound->given[i], argument)) return false;
  }
  return true;
}

py::object call_any(const Function& function, const py::args& arguments) {
  for (const Bound& bound : function.overloads) {
    if (bound.function == nullptr || bound.given.size() != arguments.size()) continue;
    if (recording() == nullptr || bound.machine == nullptr) {
      Loaded loaded{&function, &bound, {}, {}};
      if (load(loaded, arguments)) return run(loaded);
    } else {
      auto loaded = std::unique_ptr<Loaded>(new Loaded{&function, &bound, {}, {}});
      if (!load(*loaded, arguments)) continue;
      py::object result = run(*loaded);
      if (recording() != nullptr) recording()->add(std::move(loaded));
      return result;
    }
  }
  throw py::type_error(function.name + ": incompatible function arguments");
}

// Returns the CRC-32 of a text, as in zlib.
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
    "most_held: int\n"
    "\n"
    "class Unchanged:\n"
    "    def contents(self, container: Any, free: Sequence[str] = ..., read: set[str] | None = ...) -> None: ...\n"
    "    def entries(self, dictionary: dict[str, Any], names: Sequence[str]) -> None: ...\n"
    "    def attributes(self, object: Any, names: Sequence[str]) -> None: ...\n"
    "    def answer(self, function: Any) -> None: ...\n"
    "    def place(self, tensor: Tensor) -> None: ...\n"
    "    def layout(self, tensor: Tensor) -> None: ...\n"
    "    def values(self, tensor: Tensor, copy: Tensor) -> None: ...\n"
    "    def kind(self, dictionary: dict[str, Any], name: str) -> None: ...\n"
    "    def holds(self) -> bool: ...\n"
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
    "class TensorRules:\n"
    "    def __init__(self, rows: Sequence[Any]) -> None: ...\n"
    "    def __call__(self, op: str, tensors: list[Tensor], smooth: bool) -> dict[str, int] | None: ...\n"
    "\n"
    "class ProgramCall:\n"
    "    def __init__(self, program: Program, widths: Sequence[Any], sums: Sequence[Any], kept: Sequence[int],\n"
    "                 tables: Sequence[int], sizes: Sequence[int], rays: int, large: int, on_large: Any) -> None: ...\n"
    "    def __call__(self, run: tuple[Any, ...], asked: bool) -> list[Tensor] | None: ...\n"
    "\n"
    "def signature(declaration: Any) -> Any: ...\n"
    "def way_of(arguments: tuple[Any, ...]) -> int: ...\n"
    "def register_queries(objects: dict[str, Any]) -> None: ...\n"
    "def register_torch(dtypes: dict[str, torch.dtype], classes: tuple[type, ...], exchange: Any) -> None: ...\n";

// The stub of the module for type checkers (voronerf/ops/_core/_C.pyi). Declaring a struct or an enumeration also adds
// its class or its names to the module.
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
      for (const Type* type : function.overloads[i].given) exact += (exact.empty() ? "" : ", ") + type->exact;
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
    py::list result;
    for (const std::string& text : texts) result.append(text);
    return py::tuple(result);
  }

  py::module_ module_;
  std::map<std::string, std::string> texts_;
  std::string text_;
};

}  // namespace

void Module::add(const char* name, AnyFunction function, Caller call, std::vector<const Type*> parameters,
                 const Type* result, const Type* machine) {
  std::vector<const Type*> arguments = parameters;
  if (machine != nullptr) {
    const bool two = arguments.size() > 1 && arguments[arguments.size() - 2] == &type_of<Isa>();
    if (machine == &type_of<Cpu>()) arguments.resize(arguments.size() - (two ? 2 : 1));
    if (machine == &type_of<Cuda>() && arguments.back() == &type_of<void*>()) arguments.pop_back();
    arguments.push_back(machine);
  }
  size_t bytes = 0;
  for (const Type* type : arguments) bytes += type->size + alignof(std::max_align_t);
  if (bytes > kMostBytes || arguments.size() >= kMostParameters) throw std::logic_error(name);
  Function& all = functions()[name];
  all.name = name;
  all.overloads.push_back({function, call, std::move(arguments), std::move(parameters), result, machine});
}

void load_struct(const Type& type, PyObject* tuple, void* place) {
  Frame frame;
  if (!frame.load(type, tuple, place)) throw std::invalid_argument(type.exact);
}

void bind_all(PyObject* python) {
  auto bound = py::reinterpret_borrow<py::module_>(python);
  Module module;
  for (const auto bind : bindings()) bind(module);
  Declarations declarations(bound);
  for (const auto& [name, function] : functions()) {
    declarations.declare(function);
    bool available = false;
    for (const Bound& overload : function.overloads) available = available || overload.function != nullptr;
    if (!available) continue;
    bound.def(name.c_str(), [target = &function](const py::args& arguments) { return call_any(*target, arguments); });
  }
  // The classes are module-local: the emulated module of the tests has classes of the same names.
  bind_unchanged(bound);
  py::class_<Recording>(bound, "Recording", py::module_local(), in_cycles<Recording>())
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
  bind_signatures(bound);
  bind_program_calls(bound);
  // register_torch takes Python objects of torch, with which this module is not linked: the dtypes by name, the classes
  // of plain tensors, and the capsule of torch's DLPack exchange API (tensor_view.h) or None.
  bound.def("register_torch", [](const py::dict& names, const py::tuple& classes, const py::object& exchange) {
    for (const auto& entry : names) {
      dtypes()[py::cast<std::string>(entry.first)] = py::reinterpret_borrow<py::object>(entry.second).release().ptr();
    }
    know_tensors(classes.ptr(), exchange.ptr());
  });
  const std::string text = declarations.stub();
  bound.attr("stub") = text;
  bound.attr("interface") = checksum(text);
}

}  // namespace voronerf
