// The binding file of an op only lists its functions and the structs they take:
//
//   VN_BINDINGS(module) {
//     module.cpu("nearest_centre", VN_CPU(nearest_centre_cpu<float>));
//     module.cuda("nearest_centre", VN_CUDA(nearest_centre_cuda<float>));
//   }
//
// From Python the parameters are those of the C++ function (load.h), except that the last ones are the machine: Cpu
// where the function ends with (Isa, int threads) or (int threads), Cuda where it ends with a stream, which is the
// device's. Functions of one name are told apart by dtypes, numbers of arguments and the machine. The GIL is released
// for what has a machine.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "bindings/load.h"
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
VN_NAMES(Isa, "portable", "neon", "avx2", "avx512", "avx512_bf16", "amx");
VN_STRUCT(Cpu, isa, threads);
VN_STRUCT(Cuda, device, stream);

class Module {
 public:
  // A function that ends with (Isa, int threads) or (int threads).
  template <typename R, typename... A>
  void cpu(const char* name, R (*function)(A...)) {
    add(name, function, &type_of<Cpu>());
  }
  // A function that ends with a stream, or asks something of the device.
  template <typename R, typename... A>
  void cuda(const char* name, R (*function)(A...)) {
    add(name, function, &type_of<Cuda>());
  }
  // A function of its parameters alone: a size, a check.
  template <typename R, typename... A>
  void plain(const char* name, R (*function)(A...)) {
    add(name, function, nullptr);
  }

  // Any function; call(function, places of its parameters, place of its result).
  using AnyFunction = void (*)();
  using Call = void (*)(AnyFunction, void* const*, void*);

 private:
  template <typename R, typename... A>
  void add(const char* name, R (*function)(A...), const Type* machine) {
    const Type* result = nullptr;
    if constexpr (std::is_class_v<R>) {  // a std::unique_ptr
      result = &type_of<typename ElementOf<R>::Type>();
    } else if constexpr (!std::is_void_v<R>) {
      result = &type_of<R>();
    }
    add(name, reinterpret_cast<AnyFunction>(function), &call<R, A...>, {&type_of<A>()...}, result, machine);
  }
  void add(const char* name, AnyFunction function, Call call, std::vector<const Type*> parameters, const Type* result,
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

// Binds everything to a Python module, with the stub and its checksum.
void bind_all(_object* python);

// A struct of VN_STRUCT, without tensors, from a named tuple: for the tests' modules. Throws std::invalid_argument.
void load_struct(const Type& type, _object* given, void* place);
template <typename S>
S struct_of(_object* given) {
  S value;
  load_struct(type_of<S>(), given, &value);
  return value;
}

}  // namespace voronerf
