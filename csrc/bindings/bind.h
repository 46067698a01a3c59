// The binding file of an op only lists its functions and the structs they take:
//
//   VN_BINDINGS(module) {
//     module.cpu("nearest_centre", VN_CPU(nearest_centre_cpu<float>));
//     module.cuda("nearest_centre", VN_CUDA(nearest_centre_cuda<float>));
//   }
//
// In Python a function has the parameters of the C++ function (load.h), but its last parameter is the machine: Cpu in
// place of a final (Isa, int threads) or (int threads), Cuda in place of a final stream. Overloads are selected by
// dtypes, number of arguments and machine. The GIL is released for functions with a machine.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "bindings/load.h"
#include "common/isa.h"

// VN_CUDA and VN_CPU give a pointer to a function. In a build without CUDA, VN_CUDA gives a null pointer of the
// function's type instead; in the emulated build, VN_CPU gives such a null pointer.
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
VN_NAMES(Isa, "portable", "neon", "avx2", "avx512", "avx512_bf16", "amx");
VN_STRUCT(Cpu, isa, threads);
VN_STRUCT(Cuda, device, stream);

class Module {
 public:
  // Binds a function whose last parameters are (Isa, int threads) or (int threads).
  template <typename R, typename... A>
  void cpu(const char* name, R (*function)(A...)) {
    add(name, function, &type_of<Cpu>());
  }
  // Binds a function whose last parameter is a stream, or a function that queries the device.
  template <typename R, typename... A>
  void cuda(const char* name, R (*function)(A...)) {
    add(name, function, &type_of<Cuda>());
  }
  // Binds a function without a machine, such as one that returns a size or checks arguments.
  template <typename R, typename... A>
  void plain(const char* name, R (*function)(A...)) {
    add(name, function, nullptr);
  }

  // A type-erased function, and its caller: call(function, addresses of the parameters, address of the result).
  using AnyFunction = void (*)();
  using Caller = void (*)(AnyFunction, void* const*, void*);

 private:
  template <typename R, typename... A>
  void add(const char* name, R (*function)(A...), const Type* machine) {
    const Type* result = nullptr;
    if constexpr (std::is_class_v<R>) {  // R is a std::unique_ptr
      result = &type_of<typename ElementOf<R>::Type>();
    } else if constexpr (!std::is_void_v<R>) {
      result = &type_of<R>();
    }
    add(name, reinterpret_cast<AnyFunction>(function), &call<R, A...>, {&type_of<A>()...}, result, machine);
  }
  void add(const char* name, AnyFunction function, Caller call, std::vector<const Type*> parameters, const Type* result,
           const Type* machine);

  template <typename R, typename... A>
  static void call(AnyFunction function, void* const* places, void* result) {
    call_with<R, A...>(reinterpret_cast<R (*)(A...)>(function), places, result, std::index_sequence_for<A...>());
  }
  template <typename R, typename... A, size_t... I>
  static void call_with(R (*function)(A...), [[maybe_unused]] void* const* places, [[maybe_unused]] void* result,
                        std::index_sequence<I...>) {
    if constexpr (std::is_void_v<R>) {
      function(*static_cast<std::remove_reference_t<A>*>(places[I])...);
    } else if constexpr (std::is_class_v<R>) {
      *static_cast<void**>(result) = function(*static_cast<std::remove_reference_t<A>*>(places[I])...).release();
    } else {
      *static_cast<R*>(result) = function(*static_cast<std::remove_reference_t<A>*>(places[I])...);
    }
  }
};

// The binding functions of the ops, each registered by VN_BINDINGS. A compilation unit may have several of them.
inline std::vector<void (*)(Module&)>& bindings() {
  static std::vector<void (*)(Module&)> functions;
  return functions;
}
#define VN_BINDINGS(module) VN_BINDINGS_NUMBERED(module, __COUNTER__)
#define VN_BINDINGS_NUMBERED(module, number) VN_BINDINGS_NAMED(module, number)
#define VN_BINDINGS_NAMED(module, number)                                                      \
  static void bind_##number(::voronerf::Module& module);                                       \
  static const bool bound_##number = (::voronerf::bindings().push_back(&bind_##number), true); \
  static void bind_##number([[maybe_unused]] ::voronerf::Module& module)

// Adds all bound functions, the stub and its checksum to a Python module.
void bind_all(_object* python);

// Loads a struct of VN_STRUCT without tensors from a named tuple, for the modules of the tests. Throws
// std::invalid_argument if the tuple does not fit.
void load_struct(const Type& type, _object* tuple, void* place);
template <typename S>
S struct_of(_object* tuple) {
  S value;
  load_struct(type_of<S>(), tuple, &value);
  return value;
}

}  // namespace voronerf
