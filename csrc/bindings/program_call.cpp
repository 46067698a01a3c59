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

// The view of a tensor. If torch gives none (tensor_view.h), its shape, strides and dtype come from Python attributes.
struct Look : TensorView {
  bool is_viewed = false;
  std::vector<int64_t> sizes;

  bool look(PyObject* tensor) {
    is_viewed = TensorView::look(tensor);
    if (is_viewed) return true;
    const py::handle object(tensor);
    if (!py::hasattr(object, "stride") || !py::hasattr(object, "dtype")) return false;
    sizes = py::cast<std::vector<int64_t>>(object.attr("shape"));
    dimensions = static_cast<int32_t>(sizes.size());
    const auto steps = py::cast<std::vector<int64_t>>(object.attr("stride")());
    sizes.insert(sizes.end(), steps.begin(), steps.end());
    shape = sizes.data();
    strides = shape + dimensions;
    const py::object dtype = object.attr("dtype");
    const auto is = [&dtype](const char* name) { return dtype.ptr() == dtypes().at(name); };
    code = is("bfloat16") ? 4 : is("float16") || is("float32") ? 2 : UINT8_MAX;
    bits = is("float32") ? 32 : 16;
    return true;
  }
};

// A program with the facts that its calls need: the shapes and types of the results, and the sizes of parameters.
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

  // Runs the program on a Run (voronerf/ops/network/native.py). Returns the outputs, the sums over rows and, if the run
  // keeps them, the look-ups (the features from hash grids). Returns None if Python has to make the call: during a
  // recording, for unsupported tensors and, if `asked`, while torch has to see the call (Questions::has_listeners).
  py::object call(const py::tuple& given, bool asked) const {
    PyObject* const tuple = given.ptr();
    if (recording() != nullptr || bound_ == nullptr || bound_->function == nullptr || !questions.compiled_here() ||
        !has_entries(tuple, 12)) {
      return py::none();
    }
    const bool keep = PyTuple_GET_ITEM(tuple, 10) == Py_True;
    if (asked && questions.has_listeners()) return py::none();
    TensorView offsets;
    if (!offsets.look(PyTuple_GET_ITEM(tuple, 2)) || !offsets.on_cpu()) return py::none();
    Loaded loaded{function_, bound_, {}, {}};
    Frame& frame = loaded.frame;
    loaded.values.place(type_of<Program>()) = PyCapsule_GetPointer(program_.ptr(), "Program");
    auto& in = *static_cast<ProgramInputs*>(loaded.values.place(type_of<ProgramInputs>()));
    auto& out = *static_cast<ProgramResults*>(loaded.values.place(type_of<ProgramResults>()));
    *static_cast<Cpu*>(loaded.values.place(type_of<Cpu>())) = questions.cpu();
    if (!load(frame, tuple, 0, in, true)) return py::none();
    const py::object inputs = fast(PyTuple_GET_ITEM(tuple, 0)), kept = fast(PyTuple_GET_ITEM(tuple, 5));
    in.gradients = keep && !kept_.empty() ? -1 : PyLong_AsLong(PyTuple_GET_ITEM(tuple, 11));  // all rows are kept
    in.caller = PyUnicode_AsUTF8(PyTuple_GET_ITEM(tuple, 7));
    in.ray_name = PyUnicode_AsUTF8(PyTuple_GET_ITEM(tuple, 8));

    py::list results;
    const TableType type = in.input_types[0];
    const auto memory = [&](TableType of, const std::vector<int64_t>& shape) {
      return address(results, of, shape, of == type ? at(inputs, 0) : nullptr);
    };
    void** const addresses = frame.array(widths_.size() + sums_.size());
    void** next = addresses;
    for (const auto& [width, by_ray] : widths_) {
      if (by_ray && type != TableType::float32) return py::none();  // per-ray outputs are float32
      out.output_types.push_back(type);
      *next++ = memory(type, {by_ray ? in.r : in.n, width});
    }
    for (const auto& [table, shape] : sums_) {
      const bool shared = table >= 0 && in.strides[static_cast<size_t>(table)] == 0;
      std::vector<int64_t> sizes = {shared ? 1 : in.k};
      sizes.insert(sizes.end(), shape.begin(), shape.end());
      *next++ = memory(TableType::float32, sizes);
    }
    in.ready = !keep || kept_.empty();
    void** const looked_up = frame.array(kept_.size());
    if (keep) {
      for (size_t i = 0; i < kept_.size(); ++i) looked_up[i] = memory(TableType::float32, {in.n, kept_[i]});
    } else {
      for (size_t i = 0; i < size(kept); ++i) {
        TensorView view;
        if (i >= kept_.size() || !view.look(at(kept, i))) return py::none();
        if (!frame.load_view(any(), at(kept, i), view, looked_up[i])) return py::none();
      }
    }
    if (!kept_.empty() && (keep || size(kept) != 0)) in.kept = reinterpret_cast<float* const*>(looked_up);
    out.outputs = addresses;
    out.sums = reinterpret_cast<float* const*>(addresses + widths_.size());
    run(loaded);
    return std::move(results);
  }

  // Loads inputs, parameters, offsets, order and ray_index from the entries of a tuple, from `first` on. Returns false
  // for unsupported tensors and, if `viewed`, for tensors of which torch gives no view.
  bool load(Frame& frame, PyObject* tuple, Py_ssize_t first, ProgramInputs& in, bool viewed) const {
    const py::object inputs = fast(PyTuple_GET_ITEM(tuple, first)),
                     parameters = fast(PyTuple_GET_ITEM(tuple, first + 1));
    PyObject *const offsets = PyTuple_GET_ITEM(tuple, first + 2), *const ray_index = PyTuple_GET_ITEM(tuple, first + 4);
    const size_t count = size(inputs), parameter_count = size(parameters);
    if (parameter_count != sizes_.size() || count == 0) return false;
    std::vector<Look> views(count);
    for (size_t i = 0; i < count; ++i) {
      if (!views[i].look(at(inputs, i)) || views[i].dimensions != 2 || (viewed && !views[i].is_viewed)) return false;
    }
    Look cells, index;
    if (!cells.look(offsets) || (ray_index != Py_None && !index.look(ray_index))) return false;
    in.n = ray_index == Py_None ? views[0].shape[0] : index.shape[0];
    in.r = rays_ < 0 ? 0 : views[static_cast<size_t>(rays_)].shape[0];
    in.k = cells.shape[0] - 1;

    // The number of rows of a per-sample input. It is -1 if there are as many rays as samples, because the shape of an
    // input then does not tell whether its rows are samples or rays.
    const int64_t samples = ray_index != Py_None && in.n == in.r ? -1 : int64_t{in.n};
    const unsigned dtype = views[0].dtype();
    if ((dtype & (kFloat32 | kBfloat16 | (viewed ? 0 : kFloat16))) == 0) return false;  // float16 on CUDA alone
    void **const pointers = frame.array(count), **const of_parameters = frame.array(parameter_count);
    for (size_t i = 0; i < count; ++i) {
      if (views[i].dtype() != dtype) return false;
      const bool transposed = is_transposed(views[i], samples) && !is_negative(at(inputs, i));
      in.input_types.push_back(table_type(dtype));
      in.transposed.push_back(static_cast<int32_t>(transposed));
      if (transposed) {
        const py::object turned = py::handle(at(inputs, i)).attr("t")();
        if (!load_any(frame, turned.ptr(), pointers[i])) return false;
      } else if (!load_any(frame, at(inputs, i), views[i], pointers[i])) {
        return false;
      }
    }
    for (size_t i = 0; i < parameter_count; ++i) {
      Look view;
      if (!view.look(at(parameters, i)) || view.dimensions < 1 || (viewed && !view.is_viewed)) return false;
      const bool table = std::find(tables_.begin(), tables_.end(), i) != tables_.end();
      if (!table && view.dtype() != kFloat32) return false;
      in.parameter_types.push_back(table_type(view.dtype()));
      in.strides.push_back(view.shape[0] > 1 ? sizes_[i] : 0);
      if (!load_any(frame, at(parameters, i), view, of_parameters[i])) return false;
    }
    in.inputs = pointers;
    in.parameters = of_parameters;
    return member(frame, tuple, first + 2, in.offsets) && member(frame, tuple, first + 3, in.order) &&
           member(frame, tuple, first + 4, in.ray_index);
  }

  template <typename T>
  static bool member(Frame& frame, PyObject* tuple, Py_ssize_t place, T& value) {
    void* target = &value;
    return frame.load(type_of<T>(), PyTuple_GET_ITEM(tuple, place), target);
  }

 private:
  static const Type& any() { return type_of<const void*>(); }
  static bool load_any(Frame& frame, PyObject* tensor, void*& address) {
    void* target = &address;
    return frame.load(any(), tensor, target);
  }
  static bool load_any(Frame& frame, PyObject* tensor, const Look& view, void*& address) {
    return view.is_viewed ? frame.load_view(any(), tensor, view, address) : load_any(frame, tensor, address);
  }
  static py::object fast(PyObject* sequence) {
    return py::reinterpret_steal<py::object>(PySequence_Fast(sequence, "a program takes lists"));
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
  // Adds a new tensor to the results and returns its address; `like` is null or a tensor of the same type.
  void* address(py::list& results, TableType type, const std::vector<int64_t>& shape, PyObject* like) const {
    const bool narrow = type == TableType::bfloat16;
    const auto tensor = questions.new_memory(shape, questions.dtypes.at(narrow ? kBfloat16 : kFloat32), like);
    int64_t bytes = narrow ? 2 : 4;
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

// Loads a tuple (ProgramCall, inputs, parameters, offsets, order, ray_index, kept, ready, gradients, caller, ray_name,
// n, r), with the members of ProgramInputs.
bool Loader<ProgramInputs>::load(void* frame_of_call, PyObject* tuple, void* place) {
  if (!has_entries(tuple, 13) || !py::isinstance<ProgramCall>(PyTuple_GET_ITEM(tuple, 0))) return false;
  auto& frame = *static_cast<Frame*>(frame_of_call);
  auto& in = *static_cast<ProgramInputs*>(place);
  const auto member = [&](Py_ssize_t i, auto& value) { return ProgramCall::member(frame, tuple, i, value); };
  return py::cast<const ProgramCall&>(py::handle(PyTuple_GET_ITEM(tuple, 0))).load(frame, tuple, 1, in, false) &&
         member(6, in.kept) && member(7, in.ready) && member(8, in.gradients) && member(9, in.caller) &&
         member(10, in.ray_name) && member(11, in.n) && member(12, in.r);
}

void bind_program_calls(py::module_& module) {
  py::class_<ProgramCall>(module, "ProgramCall", py::module_local())
      .def(
          py::init<py::object, std::vector<std::pair<int64_t, bool>>, std::vector<std::pair<int, std::vector<int64_t>>>,
                   std::vector<int64_t>, std::vector<size_t>, std::vector<int64_t>, int, int64_t, py::object>())
      .def("__call__", &ProgramCall::call);
}

}  // namespace voronerf
