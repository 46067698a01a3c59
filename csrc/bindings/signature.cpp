#include "bindings/signature.h"

#include <pybind11/stl.h>

#include <algorithm>
#include <memory>

#include "bindings/frame.h"
#include "bindings/questions.h"
#include "bindings/tensor_rules.h"

namespace voronerf {

namespace {

constexpr int kMostArguments = 32;

// Returns how to call a custom op with these arguments. 0: without torch's dispatcher and without gradients. 1: without
// the dispatcher, but with gradients. 2: undecided; Python decides.
int way_of(PyObject* arguments, bool top = true) {
  if (top && questions.has_listeners()) return 2;
  bool learns = false;
  for (Py_ssize_t i = 0; i < PySequence_Fast_GET_SIZE(arguments); ++i) {
    PyObject* const argument = PySequence_Fast_GET_ITEM(arguments, i);
    if (argument == Py_None || PyUnicode_CheckExact(argument) || PyLong_CheckExact(argument) || PyBool_Check(argument))
      continue;
    TensorView view;
    if (view.look(argument)) {
      if (!view.on_cpu()) return 2;
      learns = learns || ((view.dtype() & kFloating) != 0 && requires_gradient(argument));
    } else if (PyList_CheckExact(argument) || PyTuple_CheckExact(argument)) {
      const int inner = way_of(argument, false);
      if (inner == 2) return 2;
      learns = learns || inner == 1;
    } else if (!PyFloat_CheckExact(argument)) {
      return 2;
    }
  }
  return top && learns && !questions.grad() ? 0 : static_cast<int>(learns);
}

struct Argument {
  enum class Kind { tensor, integer, flag, number, text, instance, any };
  Kind kind = Kind::any;
  py::str name;
  bool optional = false, detached = false;
  py::object otherwise;  // the default; null: no default
  py::object check;      // the check in Python of a value that is no tensor; returns the value
  TensorRule rule;
  int condition = -1;  // the shape is the first of two if this argument is not None
  int letter = -1;     // the letter of an integer argument that shapes refer to
  int64_t low = 0, high = 0;
  double from = 0, to = 0;
  bool positive = false, interval = false, open = false;
  py::tuple choices;
  py::object kind_of;
  size_t entries = 0;  // the number of entries of kind_of, if it is a named tuple
};

// The state of a call while its arguments are checked.
struct CheckedCall {
  CheckedCall(const py::str& op, const Letters& letters) : common(op, letters) {}
  PyObject* values[kMostArguments] = {};
  TensorView views[kMostArguments];
  Common common;
  std::vector<py::object> own;  // converted arguments, kept alive
  py::object given;             // the values as a named tuple, made on demand
};

// A plan to call a compiled function with the arguments of an op: the source of each of its parameters.
class Plan {
 public:
  struct Binding {
    enum class Kind { argument, rays, letter, result, memory, constant, function, structure };
    Kind kind = Kind::constant;
    int place = 0;
    int64_t bytes = 0;
    std::vector<Letters::Size> sizes;
    py::object object;
    std::vector<Binding> members;
  };
  struct Size {
    Letters::Size size;
    py::object function;  // null: the size is a letter or a number
  };
  struct Result {
    int like, condition;
    py::object dtype;
    std::vector<Size> shape, otherwise;
  };

  // Reads (name of the function, sources, results, class of the results or None, function that is called if the result
  // is False).
  Plan(const py::tuple& parts, Letters& letters) : function_(&functions().at(py::cast<std::string>(parts[0]))) {
    for (const auto& source : parts[1]) bindings_.push_back(binding_of(source, letters));
    for (const auto& row : parts[2]) {
      const auto result = py::cast<py::tuple>(row);
      results_.push_back({py::cast<int>(result[0]), py::cast<int>(result[2]), result[1], sizes_of(result[3], letters),
                          sizes_of(result[4], letters)});
    }
    kind_ = parts[3];
    fault_ = parts[4];
  }

  // Runs the function and returns its results; null if no overload takes the arguments or a result has no view.
  py::object run(CheckedCall& call, const py::object& inputs, size_t count) const {
    std::vector<py::object> results;
    results.reserve(results_.size());
    std::vector<TensorView> views(results_.size());
    for (size_t i = 0; i < results_.size(); ++i) {
      results.push_back(memory(results_[i], call, inputs, count));
      if (!results.back() || !views[i].look(results.back().ptr())) return {};
    }
    for (const Bound& bound : function_->overloads) {
      if (bound.function == nullptr || bound.machine != &type_of<Cpu>()) continue;
      if (bound.given.size() != bindings_.size() + 1) continue;
      Loaded loaded{function_, &bound, {}, {}};
      std::vector<std::unique_ptr<char[]>> memories;
      const Loading loading{call, results, views, loaded.frame, memories, inputs, count};
      bool fits = true;
      for (size_t i = 0; fits && i < bindings_.size(); ++i) {
        void*& place = loaded.values.place(*bound.given[i]);
        fits = loading.load(bindings_[i], *bound.given[i], place);
      }
      if (!fits) continue;
      *static_cast<Cpu*>(loaded.values.place(type_of<Cpu>())) = questions.cpu();
      const py::object answer = voronerf::run(loaded);
      if (answer.ptr() == Py_False && !fault_.is_none()) fault_(given(call, inputs, count));
      if (results.size() == 1) return results[0];
      if (results.empty()) return py::none();
      py::tuple tuple(results.size());
      for (size_t i = 0; i < results.size(); ++i) tuple[i] = results[i];
      if (kind_.is_none()) return std::move(tuple);
      return PyType_Check(kind_.ptr()) ? named(kind_, tuple) : kind_(tuple);
    }
    return {};
  }

  // Returns an instance of a named tuple class.
  static py::object named(const py::object& kind, const py::tuple& values) {
    const py::tuple arguments = py::make_tuple(values);
    return py::reinterpret_steal<py::object>(
        PyTuple_Type.tp_new(reinterpret_cast<PyTypeObject*>(kind.ptr()), arguments.ptr(), nullptr));
  }
  static const py::object& given(CheckedCall& call, const py::object& inputs, size_t count) {
    if (!call.given) {
      py::tuple values(count);
      for (size_t i = 0; i < count; ++i) values[i] = py::reinterpret_borrow<py::object>(call.values[i]);
      call.given = named(inputs, values);
    }
    return call.given;
  }

 private:
  static std::vector<Size> sizes_of(const py::handle& entries, Letters& letters) {
    std::vector<Size> results;
    for (const auto& entry : entries) {
      if (PyCallable_Check(entry.ptr()) != 0) {
        results.push_back({{}, py::reinterpret_borrow<py::object>(entry)});
      } else {
        results.push_back({letters.sizes(py::make_tuple(entry))[0], {}});
      }
    }
    return results;
  }
  static Binding binding_of(const py::handle& description, Letters& letters) {
    const auto parts = py::cast<py::tuple>(description);
    const auto kind = py::cast<std::string>(parts[0]);
    Binding source;
    if (kind == "argument" || kind == "result" || kind == "rays") {
      source.kind = kind == "result" ? Binding::Kind::result
                    : kind == "rays" ? Binding::Kind::rays
                                     : Binding::Kind::argument;
      source.place = py::cast<int>(parts[1]);
    } else if (kind == "letter") {
      source.kind = Binding::Kind::letter;
      source.sizes = letters.sizes(py::make_tuple(parts[1]));
    } else if (kind == "memory") {
      source.kind = Binding::Kind::memory;
      source.bytes = py::cast<int64_t>(parts[1]);
      source.sizes = letters.sizes(parts[2]);
    } else if (kind == "structure") {
      source.kind = Binding::Kind::structure;
      for (const auto& member : parts[1]) source.members.push_back(binding_of(member, letters));
    } else {
      source.kind = kind == "function" ? Binding::Kind::function : Binding::Kind::constant;
      source.object = parts[1];
    }
    return source;
  }

  py::object memory(const Result& result, CheckedCall& call, const py::object& inputs, size_t count) const {
    const bool second = result.condition >= 0 && call.values[result.condition] == Py_None;
    std::vector<int64_t> shape;
    shape.reserve(4);
    for (const Size& size : second ? result.otherwise : result.shape) {
      shape.push_back(size.function ? py::cast<int64_t>(size.function(given(call, inputs, count)))
                                    : call.common.size(size.size));
    }
    PyObject* const of_like = questions.dtypes.at(call.views[result.like].dtype());
    PyObject* const dtype = result.dtype.is_none() ? of_like : result.dtype.ptr();
    return questions.new_memory(shape, dtype, dtype == of_like ? call.values[result.like] : nullptr);
  }

  // Loads the parameters of the function from their sources.
  struct Loading {
    CheckedCall& call;
    const std::vector<py::object>& results;
    const std::vector<TensorView>& views;
    Frame& frame;
    std::vector<std::unique_ptr<char[]>>& memories;
    const py::object& inputs;
    size_t count;

    bool load(const Binding& source, const Type& type, void*& place) const {
      switch (source.kind) {
        case Binding::Kind::argument: {
          PyObject* const value = call.values[source.place];
          if (type.kind != Type::Kind::tensor || value == Py_None) return frame.load(type, value, place);
          return frame.load_view(type, value, call.views[source.place], *static_cast<void**>(place));
        }
        case Binding::Kind::rays:  // whether the argument has a row per ray
          if (type.kind != Type::Kind::boolean) return false;
          *static_cast<bool*>(place) = call.views[source.place].dimensions > 1;
          return true;
        case Binding::Kind::letter: {
          const int64_t size = call.common.size(source.sizes[0]);
          if (type.kind == Type::Kind::rows) {
            *static_cast<RowCount*>(place) = size;
          } else if (type.kind == Type::Kind::integer) {
            std::memcpy(place, &size, type.size);
          } else {
            return false;
          }
          return true;
        }
        case Binding::Kind::result: {
          const TensorView& view = views[static_cast<size_t>(source.place)];
          *static_cast<void**>(place) = view.address();
          return type.dtypes == 0 || (view.dtype() & type.dtypes) != 0;
        }
        case Binding::Kind::memory: {
          int64_t bytes = source.bytes;
          for (const auto& size : source.sizes) bytes *= call.common.size(size);
          memories.emplace_back(new char[static_cast<size_t>(bytes) + 64]);
          const auto begin = reinterpret_cast<std::uintptr_t>(memories.back().get());
          *static_cast<void**>(place) = reinterpret_cast<void*>((begin + 63) / 64 * 64);
          return true;
        }
        case Binding::Kind::constant:
          return frame.load(type, source.object.ptr(), place);
        case Binding::Kind::function: {
          const py::object value = source.object(Plan::given(call, inputs, count));
          frame.keep(value.ptr());
          return frame.load(type, value.ptr(), place);
        }
        default: {
          if (type.kind != Type::Kind::structure || type.members.size() != source.members.size()) return false;
          char* const begin = static_cast<char*>(place);
          for (size_t i = 0; i < type.members.size(); ++i) {
            void* at = begin + type.members[i].offset;
            if (!load(source.members[i], *type.members[i].type, at)) return false;
          }
          return true;
        }
      }
    }
  };

  const Function* function_;
  std::vector<Binding> bindings_;
  std::vector<Result> results_;
  py::object kind_, fault_;
};

class Signature {
 public:
  // Reads a Declaration (declare.py).
  explicit Signature(const py::object& declaration) : op_(declaration.attr("name")) {
    positional_ = py::cast<int>(declaration.attr("_positional"));
    const py::dict places = declaration.attr("_places"), defaults = declaration.attr("_defaults");
    for (const auto& row : declaration.attr("arguments")) arguments_.push_back(argument_of(row, declaration, places));
    arguments_.emplace_back();
    arguments_.back().name = "backend";
    if (arguments_.size() > kMostArguments) throw std::invalid_argument("too many arguments");
    for (Argument& argument : arguments_) {
      PyObject* name = argument.name.release().ptr();
      PyUnicode_InternInPlace(&name);
      argument.name = py::reinterpret_steal<py::str>(name);
      if (defaults.contains(argument.name)) argument.otherwise = defaults[argument.name];
    }
    for (const auto& entry : py::cast<py::dict>(declaration.attr("filled"))) {
      filled_.push_back({letters_.number(py::cast<std::string>(entry.first)), py::cast<std::string>(entry.second)});
    }
    for (const auto& name : declaration.attr("compared")) compared_.push_back(py::cast<size_t>(places[name]));
    smooth_ = py::len(declaration.attr("smooth")) != 0;
    inputs_ = declaration.attr("Inputs");
    prepare_ = declaration.attr("prepare");
    function_ = declaration.attr("function");
    found_ = declaration.attr("_implementation");
    pack_ = declaration.attr("_pack");
  }

  // Checks the arguments, raises the error, and returns the results of a call; NotImplemented if Python has to check
  // the call.
  py::object call(PyObject* args, PyObject* options) {
    CheckedCall call(op_, letters_);
    const size_t count = arguments_.size() - 1;  // excludes the backend
    bind(args, options, call);
    check(call);
    bool learns = false;
    for (size_t i = 0; i < count; ++i) learns = detach(i, call) || learns;
    const bool recorded_gradients = call.common.learns && questions.grad();
    learns = learns && recorded_gradients;
    for (size_t i = 0; recorded_gradients && smooth_ && i < count; ++i) {
      if (call.views[i].is_there()) refuse_inference(arguments_[i].rule.name, call.values[i], call.common);
    }
    if (!prepare_.is_none() && !are_alike(call)) prepare(call);
    const Implementation* const chosen = choose(call);
    if (chosen->plan && !learns && call.common.viewed && recording() == nullptr && call.views[0].on_cpu() &&
        questions.compiled_here() && (!chosen->narrow || call.common.first_float == kFloat32) &&
        !questions.has_listeners()) {
      if (py::object result = chosen->plan->run(call, inputs_, count)) return result;
    }
    PyObject* const reference = PyObject_Vectorcall(chosen->run.ptr(), call.values, count, nullptr);
    if (reference == nullptr) throw py::error_already_set();
    const py::object result = py::reinterpret_steal<py::object>(reference);
    return pack_.is_none() ? result : pack_(result);
  }

 private:
  struct Implementation {
    py::object name, backend, run;
    std::unique_ptr<Plan> plan;
    bool narrow;
  };

  Argument argument_of(const py::handle& row, const py::object& declaration, const py::dict& places) {
    Argument argument;
    argument.name = row.attr("name");
    argument.optional = py::cast<bool>(row.attr("optional"));
    argument.check = row.attr("check");
    const auto text = py::cast<std::string>(row.attr("text"));
    const py::object type = row.attr("kind"), rule = row.attr("rule");
    const auto is = [&type](PyTypeObject& each) { return type.ptr() == reinterpret_cast<PyObject*>(&each); };
    using Kind = Argument::Kind;
    if (py::hasattr(rule, "dtypes")) {
      argument.kind = Kind::tensor;
      argument.rule = TensorRule::of(rule, letters_);
      const py::object condition = rule.attr("condition");
      if (places.contains(condition)) argument.condition = py::cast<int>(places[condition]);
      const bool smooth = declaration.attr("smooth").contains(argument.name);
      argument.detached = !smooth && py::cast<bool>(row.attr("floating"));
    } else if (is(PyLong_Type)) {
      argument.kind = Kind::integer;
      std::tie(argument.low, argument.high) = py::cast<std::pair<int64_t, int64_t>>(rule);
      const bool bound = declaration.attr("_bound").contains(argument.name);
      if (bound) argument.letter = letters_.number(py::cast<std::string>(argument.name));
    } else if (is(PyFloat_Type)) {
      argument.kind = Kind::number;
      argument.positive = text == "positive";
      argument.interval = !text.empty() && !argument.positive;
      argument.open = argument.interval && text.back() == ')';
      if (argument.interval) std::tie(argument.from, argument.to) = py::cast<std::pair<double, double>>(rule);
    } else if (is(PyBool_Type)) {
      argument.kind = Kind::flag;
    } else if (is(PyUnicode_Type)) {
      argument.kind = Kind::text;
      argument.choices = py::tuple(rule);
    } else if (PyType_Check(rule.ptr())) {
      argument.kind = Kind::instance;
      argument.kind_of = rule;
      if (py::hasattr(rule, "_fields")) argument.entries = py::len(rule.attr("_fields"));
    }
    return argument;
  }

  // Puts the arguments in order. If some are missing, unknown or repeated, the empty function of the signature raises
  // Python's error.
  void bind(PyObject* args, PyObject* options, CheckedCall& call) const {
    if (!bound(args, options, call))
      function_(*py::reinterpret_borrow<py::args>(args), **py::reinterpret_borrow<py::kwargs>(options));
  }
  bool bound(PyObject* args, PyObject* options, CheckedCall& call) const {
    const auto positional_count = static_cast<size_t>(PyTuple_GET_SIZE(args));
    if (positional_count > static_cast<size_t>(positional_)) return false;
    for (size_t i = 0; i < positional_count; ++i) call.values[i] = PyTuple_GET_ITEM(args, static_cast<Py_ssize_t>(i));
    PyObject *key, *value;
    for (Py_ssize_t at = 0; PyDict_Next(options, &at, &key, &value) != 0;) {
      size_t i = positional_count;
      while (i < arguments_.size() && arguments_[i].name.ptr() != key) ++i;
      if (i == arguments_.size()) {  // the name is not interned, or the argument was already passed by position
        for (i = positional_count; i < arguments_.size() && PyUnicode_Compare(arguments_[i].name.ptr(), key) != 0;) ++i;
        if (i == arguments_.size()) return false;
      }
      call.values[i] = value;
    }
    for (size_t i = positional_count; i < arguments_.size(); ++i) {
      if (call.values[i] == nullptr) call.values[i] = arguments_[i].otherwise.ptr();
      if (call.values[i] == nullptr) return false;
    }
    return true;
  }

  void check(CheckedCall& call) const {
    for (size_t i = 0; i < arguments_.size(); ++i) {
      const Argument& argument = arguments_[i];
      PyObject*& value = call.values[i];
      if (argument.optional && value == Py_None) continue;
      if (argument.kind == Argument::Kind::tensor) {
        const bool second = argument.condition >= 0 && call.values[argument.condition] == Py_None;
        argument.rule.check(value, call.views[i], second, call.common);
      } else if (!fits(argument, value, call)) {
        call.own.push_back(argument.check(op_, py::handle(value)));
        value = call.own.back().ptr();
        if (argument.letter >= 0) throw ForPython();  // a symbolic number
      }
    }
    for (size_t i = 0; i + 1 < arguments_.size(); ++i) {
      if (call.views[i].is_there()) arguments_[i].rule.check_memory(call.values[i], call.views[i], call.common);
    }
    for (const auto& [letter, rule] : filled_) {
      if (call.common.letters[letter] < 1) throw py::value_error(py::cast<std::string>(op_) + ": " + rule);
    }
  }
  // Returns whether a value that is no tensor fits. If not, the check in Python decides.
  bool fits(const Argument& argument, PyObject*& value, CheckedCall& call) const {
    switch (argument.kind) {
      case Argument::Kind::integer: {
        if (!PyLong_Check(value) || PyBool_Check(value)) return false;
        int overflow = 0;
        const int64_t number = PyLong_AsLongLongAndOverflow(value, &overflow);
        if (overflow != 0 || number < argument.low || number > argument.high) return false;
        return argument.letter < 0 || call.common.bind(argument.letter, number);
      }
      case Argument::Kind::number: {
        if (!PyFloat_CheckExact(value) && !PyLong_CheckExact(value)) return false;
        const double number = PyFloat_AsDouble(value);
        if (number == -1 && PyErr_Occurred() != nullptr) return PyErr_Clear(), false;
        if (argument.positive && !(number > 0)) return false;
        if (argument.interval &&
            !((argument.from <= number && number < argument.to) || (number == argument.to && !argument.open))) {
          return false;
        }
        if (PyLong_CheckExact(value)) {
          call.own.push_back(py::float_(number));
          value = call.own.back().ptr();
        }
        return true;
      }
      case Argument::Kind::flag:
        return PyBool_Check(value);
      case Argument::Kind::text:
        if (!PyUnicode_CheckExact(value)) return false;
        return std::any_of(argument.choices.begin(), argument.choices.end(), [value](const py::handle& choice) {
          return choice.ptr() == value || PyUnicode_Compare(choice.ptr(), value) == 0;
        });
      case Argument::Kind::instance:
        if (reinterpret_cast<PyObject*>(Py_TYPE(value)) != argument.kind_of.ptr()) return false;
        return argument.entries == 0 || has_entries(value, argument.entries);
      default:
        return true;
    }
  }
  // Detaches the value if the op is not differentiable with respect to this argument. Returns whether the value still
  // requires a gradient.
  bool detach(size_t i, CheckedCall& call) const {
    if (!call.views[i].is_there() || (call.views[i].dtype() & kFloating) == 0) return false;
    if (!requires_gradient(call.values[i])) return false;
    call.common.learns = true;
    if (!arguments_[i].detached) return true;
    static PyObject* const word = PyUnicode_InternFromString("detach");
    call.own.push_back(py::reinterpret_steal<py::object>(PyObject_CallMethodNoArgs(call.values[i], word)));
    if (!call.own.back()) throw py::error_already_set();
    call.values[i] = call.own.back().ptr();
    return false;
  }
  // Returns whether both arguments in Declaration.compared are float32 or both are float64: `prepare` is then left out.
  bool are_alike(const CheckedCall& call) const {
    if (compared_.empty()) return false;
    const unsigned one = call.views[compared_[0]].dtype(), two = call.views[compared_[1]].dtype();
    return one == two && (one & (kFloat32 | kFloat64)) != 0;
  }
  void prepare(CheckedCall& call) const {
    const size_t count = arguments_.size() - 1;
    py::object found = prepare_(Plan::given(call, inputs_, count));
    if (found.is(call.given)) return;
    const py::tuple values(found);
    for (size_t i = 0; i < count; ++i) {
      PyObject* const value = PyTuple_GET_ITEM(values.ptr(), static_cast<Py_ssize_t>(i));
      if (value == call.values[i]) continue;
      call.values[i] = value;
      call.views[i] = {};
      if (arguments_[i].kind == Argument::Kind::tensor && value != Py_None) {
        call.common.look(arguments_[i].rule.name, value, call.views[i]);
      }
    }
    call.own.push_back(values);
    call.given = {};
  }
  // Returns the implementation for the backend and the device and dtype of the first argument.
  const Implementation* choose(const CheckedCall& call) {
    static PyObject *const cpu = PyUnicode_InternFromString("cpu"), *const cuda = PyUnicode_InternFromString("cuda");
    const TensorView& first = call.views[0];
    const py::handle backend = call.values[arguments_.size() - 1];
    if (!PyUnicode_CheckExact(backend.ptr())) throw ForPython();
    py::object kind = py::reinterpret_borrow<py::object>(first.on_cpu() ? cpu : cuda);
    if (!first.on_cpu() && !first.on_cuda()) kind = py::handle(call.values[0]).attr("device").attr("type");
    const py::object index = first.on_cuda() ? py::object(py::int_(first.device_index)) : py::object(py::none());
    PyObject* const asked[] = {op_.ptr(), backend.ptr(), kind.ptr(), index.ptr(), questions.dtypes.at(first.dtype())};
    const auto name = py::reinterpret_steal<py::object>(PyObject_Vectorcall(questions.choose, asked, 5, nullptr));
    if (!name) throw py::error_already_set();
    for (const auto& each : implementations_) {
      if (each->name.equal(name) && each->backend.equal(backend)) return each.get();
    }
    const py::tuple found = found_(name, backend);
    auto made = std::make_unique<Implementation>();
    made->name = name;
    made->backend = py::reinterpret_borrow<py::object>(backend);
    made->run = found[0];
    if (!found[1].is_none()) made->plan = std::make_unique<Plan>(py::cast<py::tuple>(found[1]), letters_);
    made->narrow = py::cast<bool>(found[2]);
    implementations_.push_back(std::move(made));
    return implementations_.back().get();
  }

  py::str op_;
  int positional_;
  Letters letters_;
  std::vector<Argument> arguments_;
  std::vector<std::pair<int, std::string>> filled_;
  std::vector<size_t> compared_;
  bool smooth_ = false;
  py::object inputs_, prepare_, function_, found_, pack_;
  std::vector<std::unique_ptr<Implementation>> implementations_;
};

// Signature.call as a Python function of a tuple and a dict. A call through pybind11 would take four times as long.
PyObject* call_signature(PyObject* self, PyObject* const* given, Py_ssize_t) {
  auto* const signature = static_cast<Signature*>(PyCapsule_GetPointer(self, nullptr));
  try {
    return signature->call(given[0], given[1]).release().ptr();
  } catch (const ForPython&) {
    Py_RETURN_NOTIMPLEMENTED;
  } catch (py::error_already_set& error) {
    error.restore();
  } catch (const py::builtin_exception& error) {
    error.set_error();
  } catch (const std::bad_alloc& error) {
    PyErr_SetString(PyExc_MemoryError, error.what());
  } catch (const std::invalid_argument& error) {
    PyErr_SetString(PyExc_ValueError, error.what());
  } catch (const std::exception& error) {
    PyErr_SetString(PyExc_RuntimeError, error.what());
  }
  return nullptr;
}

}  // namespace

void bind_signatures(py::module_& module) {
  questions.own = module.ptr();
  py::class_<TensorRules>(module, "TensorRules", py::module_local())
      .def(py::init<const py::sequence&>())
      .def("__call__", &TensorRules::check);
  module.def("way_of", [](const py::tuple& arguments) { return way_of(arguments.ptr()); });
  module.def("signature", [](const py::object& declaration) {
    static PyMethodDef definition = {
        "call", reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(&call_signature)), METH_FASTCALL, nullptr};
    const py::capsule owner(new Signature(declaration), [](void* object) { delete static_cast<Signature*>(object); });
    return py::reinterpret_steal<py::object>(PyCFunction_NewEx(&definition, owner.ptr(), nullptr));
  });
  module.def("register_queries", [](const py::dict& objects) {
    const auto held = [&objects](const char* name) { return py::object(objects[name]).release().ptr(); };
    questions.grad_enabled = held("grad_enabled");
    questions.tangents = held("tangents");
    questions.torch = held("torch");
    questions.threads = held("threads");
    questions.kept = held("kept");
    questions.native = held("native");
    questions.choose = held("choose");
    questions.checks = held("checks");
    questions.listeners.clear();
    for (const auto& listener : objects["listeners"]) {
      questions.listeners.push_back(py::reinterpret_borrow<py::object>(listener).release().ptr());
    }
    for (const auto& entry : py::cast<py::dict>(objects["dtypes"])) {
      questions.dtypes[mask_of(py::cast<std::string>(entry.first))] =
          py::reinterpret_borrow<py::object>(entry.second).release().ptr();
    }
  });
}

}  // namespace voronerf
