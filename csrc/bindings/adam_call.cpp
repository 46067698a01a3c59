#include "bindings/adam_call.h"

#include "bindings/questions.h"
#include "bindings/tensor_rules.h"
#include "encoding/adam.h"

namespace voronerf {

namespace {

bool number(PyObject* object, double& value) {
  if (!PyFloat_CheckExact(object) && !PyLong_CheckExact(object)) return false;
  value = PyFloat_AsDouble(object);
  if (value == -1 && PyErr_Occurred() != nullptr) return PyErr_Clear(), false;
  return true;
}

// Loads a Rule of voronerf/ops/adam: the named tuple (step, learning_rate, betas, epsilon, dense). Returns false if a
// value is not supported.
bool load_rule(PyObject* rule, py::list& scalars, AdamRule& result) {
  PyObject *const step = PyTuple_GET_ITEM(rule, 0), *const rate = PyTuple_GET_ITEM(rule, 1),
                  *const betas = PyTuple_GET_ITEM(rule, 2), *const dense = PyTuple_GET_ITEM(rule, 4);
  const auto address = [&scalars](PyObject* scalar) {
    scalars.append(py::handle(scalar));
    TensorView view;
    return view.look(scalar) ? static_cast<float*>(view.address()) : nullptr;
  };
  result.step = address(step);
  result.rate_at = number(rate, result.rate) ? nullptr : address(rate);
  const bool pair = (PyTuple_Check(betas) || PyList_Check(betas)) && PySequence_Fast_GET_SIZE(betas) == 2;
  if (!pair || !number(PySequence_Fast_GET_ITEM(betas, 0), result.decay)) return false;
  if (!number(PySequence_Fast_GET_ITEM(betas, 1), result.decay_sq)) return false;
  if (!number(PyTuple_GET_ITEM(rule, 3), result.epsilon) || !PyBool_Check(dense)) return false;
  result.dense = dense == Py_True;
  const auto is_share = [](double beta) { return beta >= 0 && beta < 1; };
  return is_share(result.decay) && is_share(result.decay_sq) && result.epsilon > 0;
}

// Makes the step of `adam` (voronerf/ops/adam) on the CPU. Returns false without a step if an argument is invalid or of
// an unsupported type, or if a recording is active.
bool adam_step(const py::type& rule_class, const py::type& guard_class, const py::args& arguments) {
  const Function& function = functions().at("adam");
  const Bound* bound = nullptr;
  for (const Bound& overload : function.overloads) {
    if (overload.machine == &type_of<Cpu>()) bound = &overload;
  }
  if (recorded() != nullptr || bound == nullptr || bound->function == nullptr || !questions.compiled_here())
    return false;
  PyObject *const rules = arguments[0].ptr(), *const guard = arguments[5].ptr(), *const loss = arguments[6].ptr();
  if (!PyList_CheckExact(rules) && !PyTuple_CheckExact(rules)) return false;

  Loaded loaded{&function, bound, {}, {}};
  auto& of_rules = *static_cast<std::vector<AdamRule>*>(loaded.values.place(*bound->given[0]));
  void*** lists[4];
  for (size_t i = 0; i < 4; ++i) lists[i] = static_cast<void***>(loaded.values.place(*bound->given[i + 1]));
  auto& of_guard = *static_cast<AdamGuard*>(loaded.values.place(*bound->given[5]));
  auto& sizes = *static_cast<std::vector<int64_t>*>(loaded.values.place(*bound->given[6]));
  *static_cast<Cpu*>(loaded.values.place(type_of<Cpu>())) = questions.cpu();

  py::list scalars;
  of_rules.resize(static_cast<size_t>(PySequence_Fast_GET_SIZE(rules)));
  for (size_t i = 0; i < of_rules.size(); ++i) {
    PyObject* const rule = PySequence_Fast_GET_ITEM(rules, static_cast<Py_ssize_t>(i));
    if (reinterpret_cast<PyObject*>(Py_TYPE(rule)) != rule_class.ptr() || !has_entries(rule, 5)) return false;
    if (!load_rule(rule, scalars, of_rules[i])) return false;
  }
  of_guard = {};
  if (guard != Py_None) {  // a Guard: (skip, skipped, in_a_row, scale, limit)
    if (reinterpret_cast<PyObject*>(Py_TYPE(guard)) != guard_class.ptr() || !has_entries(guard, 5)) return false;
    double limit = 0;
    if (PyTuple_GET_ITEM(guard, 3) != Py_None || !number(PyTuple_GET_ITEM(guard, 4), limit)) return false;
    of_guard.limit = static_cast<float>(limit);
    float** const places[] = {&of_guard.skip, &of_guard.skipped, &of_guard.in_a_row};
    for (Py_ssize_t i = 0; i < 3; ++i) {
      TensorView view;
      if (!view.look(PyTuple_GET_ITEM(guard, i))) return false;
      *places[i] = static_cast<float*>(view.address());
      scalars.append(py::handle(PyTuple_GET_ITEM(guard, i)));
    }
  }
  if (loss != Py_None) {
    TensorView view;
    if (guard == Py_None || !view.look(loss)) return false;
    of_guard.loss = static_cast<const float*>(view.address());
    scalars.append(py::handle(loss));
  }
  py::list tensors;
  for (size_t i = 1; i < 5; ++i) tensors.append(arguments[i]);
  if (!alike(tensors, {true, false, true, true}, scalars)) return false;  // gradients need not be contiguous

  std::vector<std::vector<void*>> addresses(4, std::vector<void*>(of_rules.size()));
  for (size_t i = 0; i < 4; ++i) {
    const py::object list = tensors[i];
    if (static_cast<size_t>(PySequence_Fast_GET_SIZE(list.ptr())) != of_rules.size()) return false;
    for (size_t j = 0; j < of_rules.size(); ++j) {
      PyObject* const tensor = PySequence_Fast_GET_ITEM(list.ptr(), static_cast<Py_ssize_t>(j));
      TensorView view;
      if (!view.look(tensor) || !view.on_cpu()) return false;
      if (i == 0) sizes.push_back(view.entries());
      if (!loaded.frame.load_view(type_of<const float*>(), tensor, view, addresses[i][j])) return false;
    }
    *lists[i] = addresses[i].data();
  }
  run(loaded);
  return true;
}

}  // namespace

void bind_adam_step(py::module_& module) { module.def("adam_step", &adam_step); }

}  // namespace voronerf
