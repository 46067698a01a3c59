// One template binds every function. The binding file of an op only lists its functions and the structs they take:
//
//   VN_BINDINGS(module) {
//     module.cpu("nearest_centre", VN_CPU(nearest_centre_cpu<float>));
//     module.cuda("nearest_centre", VN_CUDA(nearest_centre_cuda<float>));
//   }
//
// From Python the parameters are those of the C++ function (load.h), except that the last ones are the machine: Cpu
// where the function ends with (Isa, int threads) or (int threads), Cuda where it ends with a stream, which is the
// device's. Functions of one name are told apart by dtypes, numbers of arguments and the machine. The GIL is released.
#pragma once

#include <pybind11/pybind11.h>

#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "bindings/load.h"
#include "common/cuda_device.h"
#include "common/isa.h"

// A build without CUDA, and the emulated one without the CPU's half, has no such function, but its signature.
#ifdef VN_WITH_CUDA
#define VN_CUDA(...) &__VA_ARGS__
#else
#define VN_CUDA(...) static_cast<decltype(&__VA_ARGS__)>(nullptr)
#endif
#ifdef VN_EMULATE
#define VN_CPU(...) static_cast<decltype(&__VA_ARGS__)>(nullptr)
#else
#define VN_CPU(...) &__VA_ARGS__
#endif

namespace voronerf {

struct Cpu {
  Isa isa;
  int threads;
};
struct Cuda {
  int device;
  std::uintptr_t stream;
};
VN_NAMES(Isa, "portable", "neon", "avx2", "avx512", "avx512_bf16");
VN_STRUCT(Cpu, isa, threads);
VN_STRUCT(Cuda, device, stream);

// A parameter of a bound function: what pybind11 gives the function of it.
template <typename A>
struct Argument {
  LoaderOf<A>* loader;
  decltype(auto) get() const { return loader->get(); }
};

}  // namespace voronerf

namespace pybind11::detail {

template <typename A>
struct type_caster<voronerf::Argument<A>> {
  static constexpr auto name = const_name("object");
  template <typename>
  using cast_op_type = voronerf::Argument<A>;
  bool load(handle given, bool) { return loader.load(given.ptr()); }
  operator voronerf::Argument<A>() { return {&loader}; }
  voronerf::LoaderOf<A> loader;
};

}  // namespace pybind11::detail

namespace voronerf {

template <typename R>
std::string result_type() {
  if constexpr (std::is_void_v<R>) {
    return "None";
  } else if constexpr (std::is_same_v<R, const char*>) {
    return "str | None";
  } else if constexpr (std::is_class_v<R>) {
    return LoaderOf<decltype(*std::declval<R>())>::python();  // a pointer that owns what it points to
  } else {
    return Loader<R>::python();
  }
}

class Module {
 public:
  explicit Module(py::module_& module) : module_(module) {}

  // A function that ends with (Isa, int threads) or (int threads).
  template <typename R, typename... A>
  void cpu(const char* name, R (*function)(A...)) {
    using All = std::tuple<A...>;
    constexpr size_t count = sizeof...(A);
    static_assert(std::is_same_v<std::tuple_element_t<count - 1, All>, int>, "the last parameter is the threads");
    if constexpr (count >= 2 && std::is_same_v < std::tuple_element_t<count<2 ? 0 : count - 2, All>, Isa>) {
      on<Cpu, All>(name, function, std::make_index_sequence<count - 2>{}, [function](const Cpu& machine, auto&&... a) {
        return function(std::forward<decltype(a)>(a)..., machine.isa, machine.threads);
      });
    } else {
      on<Cpu, All>(name, function, std::make_index_sequence<count - 1>{}, [function](const Cpu& machine, auto&&... a) {
        return function(std::forward<decltype(a)>(a)..., machine.threads);
      });
    }
  }

  // A function that ends with a stream, or asks something of the device.
  template <typename R, typename... A>
  void cuda(const char* name, R (*function)(A...)) {
    using All = std::tuple<A...>;
    constexpr size_t count = sizeof...(A);
    constexpr bool streams = std::is_same_v<std::tuple_element_t<count - 1, All>, void*>;
    on<Cuda, All>(name, function, std::make_index_sequence<count - (streams ? 1 : 0)>{},
                  [function](const Cuda& machine, auto&&... a) {
#ifdef VN_WITH_CUDA
                    const CudaDevice current(machine.device);
#endif
                    if constexpr (streams) {
                      return function(std::forward<decltype(a)>(a)..., reinterpret_cast<void*>(machine.stream));
                    } else {
                      return function(std::forward<decltype(a)>(a)...);
                    }
                  });
  }

  // A function of its parameters alone: a size, a check.
  template <typename R, typename... A>
  void plain(const char* name, R (*function)(A...)) {
    declare<R, A...>(name);
    if (function == nullptr) return;
    module_.def(name, [function](Argument<A>... a) { return function(a.get()...); });
  }

  template <typename T>
  void opaque() {
    LoaderOf<T>::declare(declarations_, module_);
    py::class_<T>(module_, Opaque<T>::type, py::module_local());
  }

  // What is bound, as a stub for type checkers (voronerf/ops/_core/_C.pyi); its checksum is the module's interface.
  std::string stub() const {
    std::string text;
    for (const auto& entry : declarations_) text += "\n" + entry.second;
    for (const auto& entry : functions_) {
      text += "\n";
      for (const Signature& one : entry.second) {
        text += "# " + one.exact + "\n";
        bool first = true;
        for (const Signature& before : entry.second) {
          if (&before == &one) break;
          first = first && before.python != one.python;
        }
        if (!first) continue;
        bool overloaded = false;
        for (const Signature& other : entry.second) overloaded = overloaded || other.python != one.python;
        text += (overloaded ? "@overload\n" : "") + one.python + "\n";
      }
    }
    return text;
  }

 private:
  struct Signature {
    std::string exact, python;
  };

  template <typename Machine, typename All, typename R, typename... A, size_t... I, typename Call>
  void on(const char* name, R (*function)(A...), std::index_sequence<I...>, Call call) {
    declare<R, std::tuple_element_t<I, All>..., Machine>(name);
    if (function == nullptr) return;
    module_.def(
        name,
        [call](Argument<std::tuple_element_t<I, All>>... a, Argument<Machine> machine) {
          return call(machine.get(), a.get()...);
        },
        py::call_guard<py::gil_scoped_release>());
  }

  template <typename R, typename... A>
  void declare(const char* name) {
    (LoaderOf<A>::declare(declarations_, module_), ...);
    std::string exact, python;
    int number = 0;
    [[maybe_unused]] const auto add = [&](const std::string& exactly, const std::string& type) {
      exact += (number == 0 ? "" : ", ") + exactly;
      python += (number == 0 ? "_" : ", _") + std::to_string(number) + ": " + type;
      ++number;
    };
    (add(LoaderOf<A>::exact(), LoaderOf<A>::python()), ...);
    functions_[name].push_back(
        {exact, "def " + std::string(name) + "(" + python + ") -> " + result_type<R>() + ": ..."});
  }

  py::module_& module_;
  Declarations declarations_;
  std::map<std::string, std::vector<Signature>> functions_;
};

// The binding files of the ops, which name themselves here, several of them in one compilation.
inline std::vector<void (*)(Module&)>& bindings() {
  static std::vector<void (*)(Module&)> all;
  return all;
}
#define VN_BINDINGS(module) VN_BINDINGS_NUMBERED(module, __COUNTER__)
#define VN_BINDINGS_NUMBERED(module, number) VN_BINDINGS_NAMED(module, number)
#define VN_BINDINGS_NAMED(module, number)                                                      \
  static void bind_##number(::voronerf::Module& module);                                       \
  static const bool bound_##number = (::voronerf::bindings().push_back(&bind_##number), true); \
  static void bind_##number([[maybe_unused]] ::voronerf::Module& module)

}  // namespace voronerf
