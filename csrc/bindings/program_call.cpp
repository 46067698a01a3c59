#include "bindings/program_call.h"

#include <pybind11/stl.h>

#include <utility>

#include "bindings/program.h"
#include "bindings/questions.h"

namespace voronerf {

namespace {

TableType table_type(unsigned dtype) {
  return dtype == kBfloat16 ? TableType::bfloat16 : dtype == kFloat16 ? TableType::float16 : TableType::float32;
}

// A program with the shapes and types of its results, which a call allocates.
class ProgramCall {
 public:
  // `widths` has, for each output, the number of columns and whether there is a row per ray. `sums` has, for each sum,
  // an index and the shape of an entry. If the sum is the gradient of a hash grid's table, the index is the parameter
  // with the table, and the sum has as many entries as that parameter. Otherwise the index is -1, and the sum has an
  // entry per cell. `kept` has, for each look-up in a hash grid, the number of columns of the memory in which a call
  // can keep the features for the backward pass, with padding. `tables` has the indices of the parameters that are
  // tables of hash grids, and `sizes` the number of elements of each parameter per cell. `rays` is the index of the
  // first input with a row per ray, or -1. on_large is called with each result of at least `large` bytes, to place it
  // on huge pages.
  ProgramCall(py::object program, std::vector<std::pair<int64_t, bool>> widths,
              std::vector<std::pair<int, std::vector<int64_t>>> sums, std::vector<int64_t> kept,
              std::vector<size_t> tables, std::vector<int64_t> sizes, int rays, int64_t large, py::object on_large)
      : program_(std::move(program)),
        widths_(std::move(widths)),
        sums_(std::move(sums)),
        kept_(std::move(kept)),
        tables_(std::move(tables)),
        sizes_(std::move(sizes)),
        rays_(rays),
        large_(large),
        on_large_(std::move(on_large)) {
    const Function& function = functions().at("grouped_program");
    for (const Bound& bound : function.overloads) {
      if (bound.machine == &type_of<Cpu>()) bound_ = &bound;
    }
    function_ = &function;
  }

  // Runs the program on `rows`: inputs, parameters, offsets, order, ray_index and the look-ups (the features from hash
  // grids) that an earlier call kept. `gradients` is the index of the first input that is a gradient, or -1. `caller`
  // is the name of the op for error messages. Returns the outputs, the sums over rows and, if `keep`, the look-ups.
  // Returns None if Python has to make the call: during a recording, for unsupported tensors and, if `asked`, while
  // torch has to see the call (Questions::has_listeners).
  py::object call(const py::tuple& rows, bool keep, int64_t gradients, const char* caller, bool asked) const {
    if (recording() != nullptr || bound_ == nullptr || bound_->function == nullptr || !questions.compiled_here()) {
      return py::none();
    }
    if (asked && questions.has_listeners()) return py::none();
    Loaded loaded{function_, bound_, {}, {}};
    Frame& frame = loaded.frame;
    loaded.values.place(type_of<Program>()) = PyCapsule_GetPointer(program_.ptr(), "Program");
    auto& in = *static_cast<ProgramInputs*>(loaded.values.place(type_of<ProgramInputs>()));
    auto& out = *static_cast<ProgramResults*>(loaded.values.place(type_of<ProgramResults>()));
    *static_cast<Cpu*>(loaded.values.place(type_of<Cpu>())) = questions.cpu();

    const py::object inputs = fast(rows[0]), parameters = fast(rows[1]), kept_lookups = fast(rows[5]);
    const size_t count = size(inputs), parameter_count = size(parameters);
    if (parameter_count != sizes_.size() || count == 0) return py::none();
    std::vector<TensorView> views(count), parameter_views(parameter_count);
    for (size_t i = 0; i < count; ++i) {
      if (!views[i].look(at(inputs, i)) || views[i].dimensions != 2) return py::none();
    }
    for (size_t i = 0; i < parameter_count; ++i) {
      if (!parameter_views[i].look(at(parameters, i)) || parameter_views[i].dimensions < 1) return py::none();
    }
    TensorView offsets, ray_view;
    PyObject* const ray_index = PyTuple_GET_ITEM(rows.ptr(), 4);
    if (!offsets.look(PyTuple_GET_ITEM(rows.ptr(), 2)) || !offsets.on_cpu()) return py::none();
    if (ray_index != Py_None && !ray_view.look(ray_index)) return py::none();
    in.n = ray_index == Py_None ? views[0].shape[0] : ray_view.shape[0];
    in.r = rays_ < 0 ? 0 : views[static_cast<size_t>(rays_)].shape[0];
    in.k = offsets.shape[0] - 1;

    // The number of rows of a per-sample input. It is -1 if there are as many rays as samples, because the shape of an
    // input then does not tell whether its rows are samples or rays.
    const int64_t samples = ray_index != Py_None && in.n == in.r ? -1 : int64_t{in.n};
    const unsigned dtype = views[0].dtype();
    if (dtype != kFloat32 && dtype != kBfloat16) return py::none();
    std::vector<void*> pointers(count + parameter_count + kept_.size());
    for (size_t i = 0; i < count; ++i) {
      if (views[i].dtype() != dtype) return py::none();
      const bool transposed = is_transposed(views[i], samples) && !is_negative(at(inputs, i));
      in.input_types.push_back(table_type(dtype));
      in.transposed.push_back(static_cast<int32_t>(transposed));
      if (transposed) {
        frame.keep(at(inputs, i));
        pointers[i] = views[i].address();
      } else if (!frame.load_view(any(), at(inputs, i), views[i], pointers[i])) {
        return py::none();
      }
    }
    for (size_t i = 0; i < parameter_count; ++i) {
      const TensorView& view = parameter_views[i];
      const bool table = std::find(tables_.begin(), tables_.end(), i) != tables_.end();
      if (!table && view.dtype() != kFloat32) return py::none();
      in.parameter_types.push_back(table_type(view.dtype()));
      in.strides.push_back(view.shape[0] > 1 ? sizes_[i] : 0);
      if (!frame.load_view(any(), at(parameters, i), view, pointers[count + i])) return py::none();
    }
    in.inputs = pointers.data();
    in.parameters = pointers.data() + count;
    if (!load(frame, rows, 2, in.offsets) || !load(frame, rows, 3, in.order) || !load(frame, rows, 4, in.ray_index)) {
      return py::none();
    }
    in.gradients = keep && !kept_.empty() ? -1 : gradients;  // look-ups are kept for all rows
    in.caller = caller;
    in.ray_name = std::strstr(caller, "_mlp") != nullptr ? "direction_index" : "ray_index";

    py::list results;
    std::vector<void*> addresses;
    for (const auto& [width, by_ray] : widths_) {
      if (by_ray && dtype != kFloat32) return py::none();  // per-ray outputs are float32
      out.output_types.push_back(table_type(dtype));
      addresses.push_back(memory(results, dtype, {by_ray ? in.r : in.n, width}));
    }
    for (const auto& [table, shape] : sums_) {
      std::vector<int64_t> sizes = {table < 0 ? in.k : parameter_views[static_cast<size_t>(table)].shape[0]};
      sizes.insert(sizes.end(), shape.begin(), shape.end());
      addresses.push_back(memory(results, kFloat32, sizes));
    }
    in.kept = nullptr;
    in.ready = true;
    void** const looked_up = pointers.data() + count + parameter_count;
    if (keep) {
      for (size_t i = 0; i < kept_.size(); ++i) looked_up[i] = memory(results, kFloat32, {in.n, kept_[i]});
      in.ready = kept_.empty();
    } else {
      for (size_t i = 0; i < size(kept_lookups); ++i) {
        TensorView view;
        if (i >= kept_.size() || !view.look(at(kept_lookups, i))) return py::none();
        if (!frame.load_view(any(), at(kept_lookups, i), view, looked_up[i])) return py::none();
      }
    }
    if (!kept_.empty() && (keep || size(kept_lookups) != 0)) in.kept = reinterpret_cast<float* const*>(looked_up);
    out.outputs = addresses.data();
    out.sums = reinterpret_cast<float* const*>(addresses.data() + widths_.size());
    run(loaded);
    return std::move(results);
  }

 private:
  static const Type& any() { return type_of<const void*>(); }
  static py::object fast(const py::handle& sequence) {
    return py::reinterpret_steal<py::object>(PySequence_Fast(sequence.ptr(), "a program takes lists"));
  }
  static size_t size(const py::object& items) { return static_cast<size_t>(PySequence_Fast_GET_SIZE(items.ptr())); }
  static PyObject* at(const py::object& items, size_t i) {
    return PySequence_Fast_GET_ITEM(items.ptr(), static_cast<Py_ssize_t>(i));
  }
  // Returns whether a per-sample input is column-major, as PyTorch's look-ups in planes return it. Inputs with three
  // columns are excluded: hash grids read their points in place, which must be row-major.
  static bool is_transposed(const TensorView& view, int64_t samples) {
    if (view.is_contiguous() || view.shape[0] != samples || view.shape[1] == 3 || view.dtype() != kFloat32)
      return false;
    return view.strides[0] == 1 && (view.shape[1] == 1 || view.strides[1] == view.shape[0]);
  }
  template <typename T>
  static bool load(Frame& frame, const py::tuple& rows, Py_ssize_t place, const T*& address) {
    void* target = &address;
    return frame.load(type_of<const T*>(), PyTuple_GET_ITEM(rows.ptr(), place), target);
  }
  void* memory(py::list& results, unsigned dtype, const std::vector<int64_t>& shape) const {
    const auto tensor = questions.new_memory(shape, questions.dtypes.at(dtype));
    int64_t bytes = dtype == kBfloat16 ? 2 : 4;
    for (const int64_t length : shape) bytes *= length;
    if (bytes >= large_) on_large_(tensor);
    results.append(tensor);
    TensorView view;
    if (!view.look(tensor.ptr())) throw std::runtime_error("torch gives no address for a new tensor");
    return view.address();
  }

  py::object program_;
  std::vector<std::pair<int64_t, bool>> widths_;
  std::vector<std::pair<int, std::vector<int64_t>>> sums_;
  std::vector<int64_t> kept_;
  std::vector<size_t> tables_;
  std::vector<int64_t> sizes_;
  int rays_;
  int64_t large_;
  py::object on_large_;
  const Function* function_;
  const Bound* bound_ = nullptr;
};

}  // namespace

void bind_program_calls(py::module_& module) {
  py::class_<ProgramCall>(module, "ProgramCall", py::module_local())
      .def(
          py::init<py::object, std::vector<std::pair<int64_t, bool>>, std::vector<std::pair<int, std::vector<int64_t>>>,
                   std::vector<int64_t>, std::vector<size_t>, std::vector<int64_t>, int, int64_t, py::object>())
      .def("__call__", &ProgramCall::call);
}

}  // namespace voronerf
