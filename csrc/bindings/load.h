// The conversion of Python arguments to C++ parameters: a Type describes each kind of parameter. Templates only build
// the descriptions, and loading is compiled once (frame.h): pybind11's templates for each function would take a fifth
// of the compile time of the extension.
//
//   T*            a tensor of this dtype, or None for null. A const tensor is made contiguous for the call, and its
//                 negative bit is resolved. The address of an empty tensor is not null.
//   T* const*     a sequence of such tensors, or None
//   std::vector   a sequence
//   enumeration   the name of a value (VN_NAMES)
//   struct        a named tuple with its members (VN_STRUCT); the module makes its class. VN_LOADER: an object that
//                 the struct's own function loads
//   numbers       int, float and bool
//   RowCount      an int, which a recording reads again at each replay (frame.h, bind.cpp)
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>
#include <string>
#include <type_traits>
#include <vector>

#include "common/row_count.h"

struct _object;
struct _typeobject;

namespace voronerf {

struct Type;

struct Member {
  std::string name;
  size_t offset;
  const Type* type;
};

struct Type {
  enum class Kind {
    none,
    boolean,
    integer,
    rows,
    floating,
    text,
    enumeration,
    tensor,
    tensors,
    sequence,
    structure,
    custom,
    opaque
  };
  Kind kind = Kind::none;
  size_t size = 0;
  std::string python, exact;        // types in Python and in C++, for the stub; a named type has its name
  std::string dtype;                // of a tensor; "any": all dtypes
  unsigned dtypes = 0;              // accepted dtypes of a tensor; 0: any. uint8 accepts bool
  bool constant = false;            // a const tensor
  bool is_signed = false;           // a signed integer
  const Type* of = nullptr;         // element type of a sequence
  std::vector<std::string> values;  // value names of an enumeration
  std::vector<Member> members;      // members of a struct
  void (*construct)(void*) = nullptr;
  void (*destroy)(void*) = nullptr;                      // for an opaque object: deletes it
  void* (*resize)(void*, size_t) = nullptr;              // for a std::vector: returns its data
  bool (*load)(void* frame, _object*, void*) = nullptr;  // for a type with a loader of its own
  mutable _object* known_dtype = nullptr;
  mutable _typeobject* known_class = nullptr;  // cached class of a struct's last argument
};

template <typename T>
const Type& type_of();

// Declares the names of an enumeration's values in order: VN_NAMES(Isa, "portable", "avx2", "avx512").
template <typename E>
struct Names;
#define VN_NAMES(E, ...)                                      \
  template <>                                                 \
  struct Names<E> {                                           \
    static constexpr const char* vn_type = #E;                \
    static constexpr const char* vn_values[] = {__VA_ARGS__}; \
  }

// Declares the members of a struct, in the order of its named tuple: VN_STRUCT(Cpu, isa, threads).
template <typename S>
struct Fields;
#define VN_STRUCT(S, ...)                                                                          \
  template <>                                                                                      \
  struct Fields<S> : S {                                                                           \
    static constexpr const char* vn_type = #S;                                                     \
    std::vector<Member> vn_members() const { return members_of(this, #__VA_ARGS__, __VA_ARGS__); } \
  }
template <typename... M>
std::vector<Member> members_of(const void* object, const char* names, const M&... members) {
  std::vector<Member> result;
  const auto add = [&](const void* member, const Type& type) {
    const char* end = names;
    while (*end != ',' && *end != '\0') ++end;
    const auto offset = static_cast<const char*>(member) - static_cast<const char*>(object);
    result.push_back({std::string(names, end), static_cast<size_t>(offset), &type});
    names = *end == ',' ? end + 2 : end;
  };
  (add(&members, type_of<M>()), ...);
  return result;
}

// Declares a struct that a function of its own loads from a Python object (frame.h).
template <typename T>
struct Loader;
#define VN_LOADER(T)                                             \
  template <>                                                    \
  struct Loader<T> {                                             \
    static constexpr const char* vn_type = #T;                   \
    static bool load(void* frame, _object* object, void* place); \
  }

// Declares a class whose objects Python gets from the module and only passes back.
template <typename T>
struct Opaque;
#define VN_OPAQUE(T)                           \
  template <>                                  \
  struct Opaque<T> {                           \
    static constexpr const char* vn_type = #T; \
  }

template <typename T, typename = void>
struct IsStruct : std::false_type {};
template <typename T>
struct IsStruct<T, std::enable_if_t<sizeof(Fields<T>) != 0>> : std::true_type {};

template <typename T, typename = void>
struct HasLoader : std::false_type {};
template <typename T>
struct HasLoader<T, std::enable_if_t<sizeof(Loader<T>) != 0>> : std::true_type {};

template <typename T>
struct ElementOf {
  using Type = void;
};
template <typename T>
struct ElementOf<std::vector<T>> {
  using Type = T;
};
template <typename T>
struct ElementOf<std::unique_ptr<T>> {
  using Type = T;
};

// Sets of tensor dtypes as bit masks; 0 means any dtype.
constexpr unsigned kFloat16 = 1, kBfloat16 = 2, kFloat32 = 4, kFloat64 = 8, kInt32 = 16, kInt64 = 32, kUint8 = 64,
                   kBool = 128, kOther = 256;
constexpr unsigned kFloating = kFloat16 | kBfloat16 | kFloat32 | kFloat64;

struct Dtype {
  const char* name;
  unsigned dtypes;
};
template <typename T>
constexpr Dtype dtype_of() {
  using V = std::remove_cv_t<T>;
  if constexpr (std::is_same_v<V, float>) return {"float32", kFloat32};
  if constexpr (std::is_same_v<V, double>) return {"float64", kFloat64};
  if constexpr (std::is_same_v<V, int32_t> || std::is_same_v<V, uint32_t>) return {"int32", kInt32};
  if constexpr (std::is_same_v<V, int64_t>) return {"int64", kInt64};
  if constexpr (std::is_same_v<V, bool>) return {"bool", kBool};
  if constexpr (std::is_same_v<V, uint8_t>) return {"uint8", kUint8 | kBool};
  return {"any", 0};
}

inline Type tensor_type(Dtype dtype, bool constant) {
  Type type;
  type.kind = Type::Kind::tensor;
  type.size = sizeof(void*);
  type.python = "Tensor | None";
  type.exact = std::string(constant ? "const " : "") + dtype.name + "*";
  type.dtype = dtype.name;
  type.dtypes = dtype.dtypes;
  type.constant = constant;
  return type;
}

inline Type named_type(Type::Kind kind, size_t size, const std::string& python, const std::string& exact) {
  Type type;
  type.kind = kind;
  type.size = size;
  type.python = python;
  type.exact = exact;
  return type;
}

template <typename T>
Type describe() {
  using Kind = Type::Kind;
  const std::string bits = std::to_string(8 * sizeof(T));
  if constexpr (std::is_same_v<T, bool>) {
    return named_type(Kind::boolean, sizeof(T), "bool", "bool");
  } else if constexpr (std::is_same_v<T, RowCount>) {
    return named_type(Kind::rows, sizeof(T), "int", "rows");
  } else if constexpr (std::is_same_v<T, const char*>) {
    return named_type(Kind::text, sizeof(T), "str | None", "text");
  } else if constexpr (std::is_integral_v<T>) {
    Type type = named_type(Kind::integer, sizeof(T), "int", (std::is_signed_v<T> ? "int" : "uint") + bits);
    type.is_signed = std::is_signed_v<T>;
    return type;
  } else if constexpr (std::is_floating_point_v<T>) {
    return named_type(Kind::floating, sizeof(T), "float", "float" + bits);
  } else if constexpr (std::is_enum_v<T>) {
    Type type = named_type(Kind::enumeration, sizeof(T), "str", Names<T>::vn_type);
    for (const char* name : Names<T>::vn_values) type.values.push_back(name);
    return type;
  } else if constexpr (std::is_pointer_v<T>) {
    using Pointed = std::remove_pointer_t<T>;
    if constexpr (std::is_pointer_v<Pointed>) {
      const Type& tensor = type_of<std::remove_const_t<Pointed>>();
      Type type = named_type(Kind::tensors, sizeof(T), "Sequence[Tensor | None] | None", tensor.exact + "*");
      type.of = &tensor;
      return type;
    } else {
      return tensor_type(dtype_of<Pointed>(), std::is_const_v<Pointed>);
    }
  } else if constexpr (IsStruct<T>::value) {
    Type type = named_type(Kind::structure, sizeof(T), Fields<T>::vn_type, Fields<T>::vn_type);
    type.members = Fields<T>().vn_members();
    type.construct = [](void* at) { new (at) T(); };
    type.destroy = [](void* at) { static_cast<T*>(at)->~T(); };
    return type;
  } else if constexpr (HasLoader<T>::value) {
    Type type = named_type(Kind::custom, sizeof(T), "tuple[Any, ...]", Loader<T>::vn_type);
    type.load = &Loader<T>::load;
    type.construct = [](void* at) { new (at) T(); };
    type.destroy = [](void* at) { static_cast<T*>(at)->~T(); };
    return type;
  } else if constexpr (!std::is_void_v<typename ElementOf<T>::Type>) {
    const Type& of = type_of<typename ElementOf<T>::Type>();
    Type type = named_type(Kind::sequence, sizeof(T), "Sequence[" + of.python + "]", of.exact + "[]");
    type.of = &of;
    type.construct = [](void* at) { new (at) T(); };
    type.destroy = [](void* at) { static_cast<T*>(at)->~T(); };
    type.resize = [](void* at, size_t count) -> void* {
      static_cast<T*>(at)->resize(count);
      return static_cast<T*>(at)->data();
    };
    return type;
  } else {
    Type type = named_type(Kind::opaque, 0, Opaque<T>::vn_type, Opaque<T>::vn_type);
    type.destroy = [](void* object) { delete static_cast<T*>(object); };
    return type;
  }
}

// Returns the Type of a parameter that is passed by value or by reference.
template <typename T>
const Type& type_of() {
  using Plain = std::remove_cv_t<std::remove_reference_t<T>>;
  if constexpr (!std::is_same_v<T, Plain>) {
    return type_of<Plain>();
  } else {
    static const Type type = describe<T>();
    return type;
  }
}

}  // namespace voronerf
