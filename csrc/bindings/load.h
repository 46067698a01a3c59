// What Python passes as what C++ takes: one Loader for each kind of parameter.
//
//   T*            a tensor of that dtype (or None, which is null); a const one is made contiguous for the call, and has
//                 its negative bit resolved. A tensor without elements is there all the same: its address is not null.
//   T* const*     a sequence of such tensors, or None
//   enumeration   the name of a value (VN_NAMES)
//   struct        a named tuple with its members (VN_STRUCT), of a class that the module makes
//   numbers       int, float and bool
//
// A Loader lives as long as the call, and with it what it has loaded. Each can say its type in Python, and its exact
// one; from these the module writes its stub.
#pragma once

#include <pybind11/pybind11.h>

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

namespace voronerf {

namespace py = pybind11;

// Names of an enumeration's values, in their order: VN_NAMES(Isa, "portable", "avx2", "avx512").
template <typename E>
struct Names;
#define VN_NAMES(E, ...)                                   \
  template <>                                              \
  struct Names<E> {                                        \
    static constexpr const char* type = #E;                \
    static constexpr const char* values[] = {__VA_ARGS__}; \
  }

// Members of a struct, in the order in which its named tuple has them: VN_STRUCT(Cpu, isa, threads).
template <typename S>
struct Fields;
template <typename S, typename M>
struct Field {
  using Type = M;
  const char* name;
  M S::* member;
};
template <typename S, typename M>
constexpr Field<S, M> field(const char* name, M S::* member) {
  return {name, member};
}
#define VN_EACH_1(S, m) field(#m, &S::m)
#define VN_EACH_2(S, m, ...) VN_EACH_1(S, m), VN_EACH_1(S, __VA_ARGS__)
#define VN_EACH_3(S, m, ...) VN_EACH_1(S, m), VN_EACH_2(S, __VA_ARGS__)
#define VN_EACH_4(S, m, ...) VN_EACH_1(S, m), VN_EACH_3(S, __VA_ARGS__)
#define VN_EACH_5(S, m, ...) VN_EACH_1(S, m), VN_EACH_4(S, __VA_ARGS__)
#define VN_EACH_6(S, m, ...) VN_EACH_1(S, m), VN_EACH_5(S, __VA_ARGS__)
#define VN_EACH_7(S, m, ...) VN_EACH_1(S, m), VN_EACH_6(S, __VA_ARGS__)
#define VN_EACH_8(S, m, ...) VN_EACH_1(S, m), VN_EACH_7(S, __VA_ARGS__)
#define VN_EACH_9(S, m, ...) VN_EACH_1(S, m), VN_EACH_8(S, __VA_ARGS__)
#define VN_EACH_10(S, m, ...) VN_EACH_1(S, m), VN_EACH_9(S, __VA_ARGS__)
#define VN_EACH_11(S, m, ...) VN_EACH_1(S, m), VN_EACH_10(S, __VA_ARGS__)
#define VN_EACH_12(S, m, ...) VN_EACH_1(S, m), VN_EACH_11(S, __VA_ARGS__)
#define VN_EACH_13(S, m, ...) VN_EACH_1(S, m), VN_EACH_12(S, __VA_ARGS__)
#define VN_EACH_14(S, m, ...) VN_EACH_1(S, m), VN_EACH_13(S, __VA_ARGS__)
#define VN_EACH_15(S, m, ...) VN_EACH_1(S, m), VN_EACH_14(S, __VA_ARGS__)
#define VN_EACH_16(S, m, ...) VN_EACH_1(S, m), VN_EACH_15(S, __VA_ARGS__)
#define VN_EACH_17(S, m, ...) VN_EACH_1(S, m), VN_EACH_16(S, __VA_ARGS__)
#define VN_PICK(_1, _2, _3, _4, _5, _6, _7, _8, _9, _10, _11, _12, _13, _14, _15, _16, _17, chosen, ...) chosen
#define VN_STRUCT(S, ...)                                                                                            \
  template <>                                                                                                        \
  struct Fields<S> {                                                                                                 \
    static constexpr const char* type = #S;                                                                          \
    static constexpr auto members =                                                                                  \
        std::make_tuple(VN_PICK(__VA_ARGS__, VN_EACH_17, VN_EACH_16, VN_EACH_15, VN_EACH_14, VN_EACH_13, VN_EACH_12, \
                                VN_EACH_11, VN_EACH_10, VN_EACH_9, VN_EACH_8, VN_EACH_7, VN_EACH_6, VN_EACH_5,       \
                                VN_EACH_4, VN_EACH_3, VN_EACH_2, VN_EACH_1, )(S, __VA_ARGS__));                      \
  }

// Objects of a class that Python has from the module, and only hands back.
template <typename T>
struct Opaque;
#define VN_OPAQUE(T)                        \
  template <>                               \
  struct Opaque<T> {                        \
    static constexpr const char* type = #T; \
  }

// Text of named tuples and enumerations in the stub, by name.
using Declarations = std::map<std::string, std::string>;

// void for any T. To clang, two specialisations that differ in std::void_t<...> alone are one.
template <typename T>
struct Void {
  using type = void;
};

template <typename T, typename = void>
struct Loader;
template <typename A>
using LoaderOf = Loader<std::remove_cv_t<std::remove_reference_t<A>>>;

// Numbers.

template <>
struct Loader<bool> {
  bool value;
  bool load(PyObject* given) { return PyBool_Check(given) && (value = given == Py_True, true); }
  bool get() const { return value; }
  static std::string python() { return "bool"; }
  static std::string exact() { return "bool"; }
  static void declare(Declarations&, py::module_&) {}
};

template <typename T>
struct Loader<T, std::enable_if_t<std::is_integral_v<T>>> {
  T value;
  bool load(PyObject* given) {
    if (!PyLong_Check(given)) return false;
    value = static_cast<T>(std::is_signed_v<T> ? PyLong_AsLongLong(given) : PyLong_AsUnsignedLongLong(given));
    return value != static_cast<T>(-1) || PyErr_Occurred() == nullptr || (PyErr_Clear(), false);
  }
  T get() const { return value; }
  static std::string python() { return "int"; }
  static std::string exact() { return (std::is_signed_v<T> ? "int" : "uint") + std::to_string(8 * sizeof(T)); }
  static void declare(Declarations&, py::module_&) {}
};

template <typename T>
struct Loader<T, std::enable_if_t<std::is_floating_point_v<T>>> {
  T value;
  bool load(PyObject* given) {
    if (!PyFloat_Check(given) && !PyLong_Check(given)) return false;
    value = static_cast<T>(PyFloat_AsDouble(given));
    return true;
  }
  T get() const { return value; }
  static std::string python() { return "float"; }
  static std::string exact() { return "float" + std::to_string(8 * sizeof(T)); }
  static void declare(Declarations&, py::module_&) {}
};

template <typename E>
struct Loader<E, std::enable_if_t<std::is_enum_v<E>>> {
  E value;
  bool load(PyObject* given) {
    if (!PyUnicode_Check(given)) return false;
    int number = 0;
    for (const char* name : Names<E>::values) {
      if (PyUnicode_CompareWithASCIIString(given, name) == 0) return value = static_cast<E>(number), true;
      ++number;
    }
    return false;
  }
  E get() const { return value; }
  static std::string python() { return "str"; }
  static std::string exact() { return Names<E>::type; }
  static void declare(Declarations& stub, py::module_& module) {
    py::list names;
    std::string text;
    for (const char* name : Names<E>::values) {
      names.append(name);
      text += std::string(text.empty() ? "" : " ") + name;
    }
    module.attr(Names<E>::type) = py::tuple(names);
    stub[Names<E>::type] = std::string(Names<E>::type) + ": tuple[str, ...]  # " + text + "\n";
  }
};

// Tensors: anything with a dtype, contiguous(), is_contiguous(), is_neg(), resolve_neg() and data_ptr(); what the
// dtypes are, Python says once (name_dtypes).

inline std::map<std::string, PyObject*>& dtypes() {
  static std::map<std::string, PyObject*> known;
  return known;
}

template <typename T>
constexpr const char* dtype_name() {
  using V = std::remove_cv_t<T>;
  if constexpr (std::is_same_v<V, float>) return "float32";
  if constexpr (std::is_same_v<V, double>) return "float64";
  if constexpr (std::is_same_v<V, int32_t> || std::is_same_v<V, uint32_t>) return "int32";
  if constexpr (std::is_same_v<V, int64_t>) return "int64";
  if constexpr (std::is_same_v<V, bool>) return "bool";
  if constexpr (std::is_same_v<V, uint8_t>) return "uint8";
  return "any";
}

template <typename T>
struct Loader<T*, std::enable_if_t<!std::is_pointer_v<T>>> {
  PyObject* kept = nullptr;
  T* address = nullptr;

  Loader() = default;
  Loader(const Loader&) = delete;
  Loader& operator=(const Loader&) = delete;
  ~Loader() { Py_XDECREF(kept); }

  bool load(PyObject* given) {
    if (given == Py_None) return true;
    static PyObject *const dtype_word = PyUnicode_InternFromString("dtype"),
                           *const address_word = PyUnicode_InternFromString("data_ptr"),
                           *const negative_word = PyUnicode_InternFromString("is_neg"),
                           *const resolve_word = PyUnicode_InternFromString("resolve_neg"),
                           *const contiguous_word =
                               PyUnicode_InternFromString(std::is_const_v<T> ? "contiguous" : "is_contiguous");
    if constexpr (!std::is_void_v<T>) {
      static PyObject* const wanted = dtypes().at(dtype_name<T>());
      PyObject* const dtype = PyObject_GetAttr(given, dtype_word);
      Py_XDECREF(dtype);  // a dtype lives as long as Python
      if (dtype != wanted) return PyErr_Clear(), false;
    }
    PyObject* const answer = PyObject_CallMethodNoArgs(given, contiguous_word);
    if (answer == nullptr) return PyErr_Clear(), false;
    if (std::is_const_v<T>) {
      kept = answer;
    } else {
      Py_DECREF(answer);  // True or False
      if (answer != Py_True) return false;
      Py_INCREF(kept = given);
    }
    PyObject* const negative = PyObject_CallMethodNoArgs(kept, negative_word);
    if (negative == nullptr) return PyErr_Clear(), false;
    Py_DECREF(negative);        // True or False
    if (negative == Py_True) {  // memory holds the values negated, as of x.conj().imag
      PyObject* const resolved = std::is_const_v<T> ? PyObject_CallMethodNoArgs(kept, resolve_word) : nullptr;
      if (resolved == nullptr) return PyErr_Clear(), false;
      Py_DECREF(std::exchange(kept, resolved));
    }
    PyObject* const number = PyObject_CallMethodNoArgs(kept, address_word);
    if (number == nullptr) return PyErr_Clear(), false;
    void* found = PyLong_AsVoidPtr(number);
    Py_DECREF(number);
    alignas(64) static char nothing[64];
    address = static_cast<T*>(found == nullptr ? nothing : found);
    return true;
  }
  T* get() const { return address; }
  static std::string python() { return "Tensor | None"; }
  static std::string exact() { return std::string(std::is_const_v<T> ? "const " : "") + dtype_name<T>() + "*"; }
  static void declare(Declarations&, py::module_&) {}
};

// Sequences: of tensors, of numbers or of structs.

template <typename T>
struct Sequence {
  std::vector<Loader<T>> parts;
  bool load(PyObject* given) {
    const auto items = py::reinterpret_steal<py::object>(PySequence_Fast(given, ""));
    if (!items) return PyErr_Clear(), false;
    parts = std::vector<Loader<T>>(static_cast<size_t>(PySequence_Fast_GET_SIZE(items.ptr())));
    for (size_t i = 0; i < parts.size(); ++i) {
      if (!parts[i].load(PySequence_Fast_GET_ITEM(items.ptr(), static_cast<Py_ssize_t>(i)))) return false;
    }
    return true;
  }
  std::vector<T> values() const {
    std::vector<T> all;
    all.reserve(parts.size());
    for (const auto& part : parts) all.push_back(part.get());
    return all;
  }
};

template <typename T>
struct Loader<T* const*> {
  Sequence<T*> sequence;
  std::vector<T*> addresses;
  bool given = false;
  bool load(PyObject* tensors) {
    if (tensors == Py_None) return true;
    given = true;
    if (!sequence.load(tensors)) return false;
    addresses = sequence.values();
    return true;
  }
  T* const* get() const { return given ? addresses.data() : nullptr; }
  static std::string python() { return "Sequence[Tensor | None] | None"; }
  static std::string exact() { return Loader<T*>::exact() + "*"; }
  static void declare(Declarations&, py::module_&) {}
};

template <typename T>
struct Loader<std::vector<T>> {
  Sequence<T> sequence;
  bool load(PyObject* given) { return sequence.load(given); }
  std::vector<T> get() const { return sequence.values(); }
  static std::string python() { return "Sequence[" + Loader<T>::python() + "]"; }
  static std::string exact() { return Loader<T>::exact() + "[]"; }
  static void declare(Declarations& stub, py::module_& module) { Loader<T>::declare(stub, module); }
};

// Structs.

template <typename S>
struct Loader<S, typename Void<decltype(Fields<S>::members)>::type> {
  template <typename Tuple>
  struct Parts;
  template <typename... F>
  struct Parts<std::tuple<F...>> {
    using Loaders = std::tuple<Loader<typename F::Type>...>;
  };
  using Members = std::remove_const_t<decltype(Fields<S>::members)>;
  static constexpr size_t kCount = std::tuple_size_v<Members>;
  using Indices = std::make_index_sequence<kCount>;

  typename Parts<Members>::Loaders parts;
  S value{};

  bool load(PyObject* given) { return is_one(given) && fill(given, Indices{}); }
  const S& get() const { return value; }
  static std::string python() { return Fields<S>::type; }
  static std::string exact() { return Fields<S>::type; }
  static void declare(Declarations& stub, py::module_& module) { declare(stub, module, Indices{}); }

 private:
  // A named tuple of these members. Almost always the class is the one that was looked at last.
  static bool is_one(PyObject* given) {
    static PyTypeObject* known = nullptr;
    if (Py_TYPE(given) == known) return true;
    if (!PyTuple_Check(given) || !py::hasattr(given, "_fields")) return false;
    const py::tuple names = py::handle(given).attr("_fields");
    if (!names.equal(all_names(Indices{}))) return false;
    Py_INCREF(Py_TYPE(given));
    known = Py_TYPE(given);
    return true;
  }
  template <size_t... I>
  static py::tuple all_names(std::index_sequence<I...>) {
    return py::make_tuple(std::get<I>(Fields<S>::members).name...);
  }
  template <size_t... I>
  bool fill(PyObject* given, std::index_sequence<I...>) {
    (fill_one<I>(given), ...);
    return true;
  }
  template <size_t I>
  void fill_one(PyObject* given) {
    constexpr auto member = std::get<I>(Fields<S>::members);
    if (!std::get<I>(parts).load(PyTuple_GET_ITEM(given, I))) {
      using Wanted = std::tuple_element_t<I, typename Parts<Members>::Loaders>;
      throw py::type_error(std::string(Fields<S>::type) + ": " + member.name + " is no " + Wanted::exact());
    }
    value.*member.member = std::get<I>(parts).get();
  }
  template <size_t... I>
  static void declare(Declarations& stub, py::module_& module, std::index_sequence<I...>) {
    if (stub.count(Fields<S>::type) != 0) return;
    (std::tuple_element_t<I, typename Parts<Members>::Loaders>::declare(stub, module), ...);
    const auto line = [](const char* name, const std::string& python, const std::string& exact) {
      return std::string("    ") + name + ": " + python + (python == exact ? "\n" : "  # " + exact + "\n");
    };
    stub[Fields<S>::type] =
        std::string("class ") + Fields<S>::type + "(NamedTuple):\n" +
        (line(std::get<I>(Fields<S>::members).name, std::tuple_element_t<I, typename Parts<Members>::Loaders>::python(),
              std::tuple_element_t<I, typename Parts<Members>::Loaders>::exact()) +
         ...);
    const auto make = py::module_::import("collections").attr("namedtuple");
    module.attr(Fields<S>::type) = make(Fields<S>::type, all_names(Indices{}));
  }
};

template <typename T>
struct Loader<T, typename Void<decltype(Opaque<T>::type)>::type> {
  py::detail::make_caster<T> caster;
  bool load(PyObject* given) { return caster.load(given, false); }
  T& get() { return static_cast<T&>(caster); }
  static std::string python() { return Opaque<T>::type; }
  static std::string exact() { return Opaque<T>::type; }
  static void declare(Declarations& stub, py::module_&) {
    stub[Opaque<T>::type] = std::string("class ") + Opaque<T>::type + ": ...\n";
  }
};

}  // namespace voronerf
