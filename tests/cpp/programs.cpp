// Runs random programs, lowered by Python (programs.py), on random cells with every instruction set of the machine. The
// tests in Python (tests/ops/test_grouped_program.py) compare numbers with the definition. Here every array has exactly
// its size, and results start poisoned and must become finite. One and three threads must agree bit for bit. All
// instruction sets must agree with the portable path, which stores no lookups and skips no rows.
#include <algorithm>
#include <fstream>

#include "cases.h"
#include "network/program.h"

namespace {

using voronerf::Isa;
using voronerf::TableType;

// Records, in the order of programs.py -------------------------------------------------------------------------------

std::ifstream file;

template <typename T>
struct is_array : std::false_type {};
template <typename T>
struct is_array<Array<T>> : std::true_type {};

template <typename... T>
void read(T&... values);

void members(voronerf::ProgramPack& p) { read(p.kind, p.parameter, p.o, p.i, p.start, p.width, p.waves, p.at); }
void members(voronerf::ProgramOperand& o) {
  read(o.parameter, o.spread, o.slot, o.stride, o.memory, o.input, o.pairs, o.start, o.width, o.place);
}
void members(voronerf::ProgramStep& s) {
  read(s.op, s.function, s.binary, s.encoding, s.finish, s.to_registers, s.order, s.width, s.slot, s.stride, s.memory);
  read(s.number, s.depth, s.sources, s.parameter, s.pairs, s.floats, s.from_registers, s.points, s.in_place, s.a, s.b);
  read(s.first, s.operand_count);
}
void members(voronerf::ProgramSum& s) {
  read(s.sum, s.kind, s.adds, s.partial, s.o, s.i, s.start, s.width, s.stride, s.size, s.waves);
}
void members(voronerf::ProgramInput& i) { read(i.width, i.ray); }
void members(voronerf::ProgramOutput& o) { read(o.width, o.ray, o.memory); }
void members(voronerf::ProgramLookup& l) { read(l.input, l.parameter, l.grid, l.memory); }
void members(voronerf::ProgramScatter& s) { read(s.input, s.parameter, s.grid, s.memory, s.sum); }
void members(voronerf::GridLevel& l) { read(l.scale, l.shift, l.side, l.entries, l.offset, l.hashed); }
void members(voronerf::HashGrid& g) { read(g.levels, g.low, g.high, g.features); }
void members(voronerf::ProgramTable& t) {
  read(t.packs, t.steps, t.operands, t.sums, t.inputs, t.outputs, t.memories, t.lookups, t.scatters, t.grids);
  read(t.sum_tensors, t.parameters, t.tile, t.columns, t.packed, t.partial, t.scratch, t.scratch_width, t.layout);
}

template <typename T>
void read_one(T& value) {
  if constexpr (is_array<T>::value) {
    size_t size = 0;
    read(size);
    value.resize(size);
    for (auto& each : value) read(each);
  } else if constexpr (std::is_arithmetic_v<T> || std::is_enum_v<T>) {
    double number = 0;
    if (!(file >> number)) fail("programs: the file ends too early");
    value = static_cast<T>(number);
  } else {
    members(value);
  }
}

template <typename... T>
void read(T&... values) {
  (read_one(values), ...);
}

// A parameter of one cell.
struct Parameter {
  int64_t size, depth;
  bool table;
};
void members(Parameter& p) {
  size_t three = 0;
  read(three, p.size, p.depth, p.table);
}

struct Description {
  voronerf::ProgramTable floats, pairs, tiles, parts;
  Array<Parameter> parameters;
  Array<int32_t> gaussians;  // inputs whose second half is variances
  int64_t gradients;         // as in ProgramInputs
};

Description next() {
  Description d;
  read(d.floats, d.pairs, d.tiles, d.parts, d.parameters, d.gaussians, d.gradients);
  return d;
}

// Tensors ------------------------------------------------------------------------------------------------------------

struct Tensor {
  TableType type;
  Array<char> bytes;

  int64_t size() const { return static_cast<int64_t>(bytes.size()) / (type == TableType::float32 ? 4 : 2); }
};

// Stores values as a type: bfloat16 as the upper half of a float, float16 as random bits of numbers below 1.
Tensor stored(const Array<float>& values, TableType type) {
  const int64_t size = static_cast<int64_t>(values.size()), each = type == TableType::float32 ? 4 : 2;
  Tensor made{type, Array<char>(size * each)};
  for (int64_t i = 0; i < size; ++i) {
    const auto half = static_cast<uint16_t>((generator() & 0x83ff) | static_cast<uint32_t>(below(15) << 10));
    const char* from = reinterpret_cast<const char*>(&values[i]) + 4 - each;
    std::memcpy(&made.bytes[i * each], type == TableType::float16 ? reinterpret_cast<const char*>(&half) : from, each);
  }
  return made;
}

Tensor nothing_written(int64_t size, TableType type = TableType::float32) {  // bits of NaN
  return {type, Array<char>(size * (type == TableType::float32 ? 4 : 2), '\xff')};
}

Array<float> widened(const Tensor& tensor) {
  if (tensor.bytes.empty()) return {};
  const int64_t each = tensor.type == TableType::float32 ? 4 : 2;
  Array<float> values(tensor.size());
  for (int64_t i = 0; i < tensor.size(); ++i) {
    std::memcpy(reinterpret_cast<char*>(&values[i]) + 4 - each, &tensor.bytes[i * each], each);
  }
  return values;
}

// Calls --------------------------------------------------------------------------------------------------------------

struct Case {
  const Description& d;
  Array<int32_t> offsets, order, ray_index, transposed;
  Array<Tensor> inputs, parameters;
  Array<TableType> input_types, parameter_types, output_types;
  Array<int64_t> strides;
  int64_t n, r, k;
  bool keeps = below(2) == 0, ready = below(2) == 0, sifts;
  double tolerance = 1e-3;

  explicit Case(const Description& given) : d(given) {
    const voronerf::ProgramTable& table = d.floats;
    k = 1 + below(6);
    n = below(4);
    for (int64_t c = 0; c <= k; ++c) {
      offsets.push_back(static_cast<int32_t>(n));
      const int64_t sizes[] = {0, 1, 47 + below(3), 95 + below(3), below(500), below(9) == 0 ? 4500 : 1300};
      if (c < k) n += sizes[below(6)];
    }
    n += below(4);  // adds rows of no cell
    bool rays = false;
    for (const voronerf::ProgramInput& input : table.inputs) rays |= input.ray;
    r = n == 0 ? 0 : 1 + below(20);
    for (int64_t i = 0; rays && i < n; ++i) ray_index.push_back(static_cast<int32_t>(below(r)));
    const bool ordered = below(2) == 0;
    for (int64_t i = 0; ordered && i < n; ++i) order.push_back(static_cast<int32_t>(i));
    std::shuffle(order.begin(), order.end(), generator);

    const bool half = table.grids.empty() && !rays && below(3) == 0;
    if (half) tolerance = 2e-2;
    sifts = d.gradients >= 0 && !half && below(4) > 0;
    const int64_t without = below(3);  // rows without a gradient: none, half or all
    Array<bool> dark(n);
    for (int64_t i = 0; i < n; ++i) dark[i] = sifts && below(2) < without;
    for (size_t i = 0; i < table.inputs.size(); ++i) {
      const auto [width, ray] = table.inputs[i];
      const int64_t rows = ray ? r : n;
      Array<float> values = uniform<float>(rows * width);
      const bool turned = !ray && !half && width != 3 && below(4) == 0;
      const bool gaussian = std::find(d.gaussians.begin(), d.gaussians.end(), i) != d.gaussians.end();
      const bool gradient = d.gradients >= 0 && static_cast<int64_t>(i) >= d.gradients;
      for (int64_t at = 0; at < rows * width; ++at) {
        const int64_t row = turned ? at % rows : at / width, column = turned ? at / rows : at % width;
        if (gaussian && column >= width / 2) values[at] = std::fabs(values[at]);
        if (gradient && dark[row]) values[at] = 0.0f;
      }
      transposed.push_back(turned);
      input_types.push_back(half ? TableType::bfloat16 : TableType::float32);
      inputs.push_back(stored(values, input_types.back()));
    }
    for (const Parameter& parameter : d.parameters) {
      const bool shared = below(3) == 0 || k == 1;
      Array<float> values = uniform<float>((shared ? 1 : k) * parameter.size);
      for (float& value : values) value /= static_cast<float>(parameter.depth);
      parameter_types.push_back(parameter.table ? static_cast<TableType>(below(3)) : TableType::float32);
      parameters.push_back(stored(values, parameter_types.back()));
      strides.push_back(shared ? 0 : parameter.size);
    }
    output_types.assign(table.outputs.size(), half ? TableType::bfloat16 : TableType::float32);
  }

  // Returns outputs, then sums, then stored lookups. `plain` stores no lookups and skips no rows.
  Array<Tensor> run(Isa isa, const voronerf::ProgramTable& table, int threads, bool plain) const {
    const auto program = voronerf::make_program(table);
    Array<Tensor> results;
    for (size_t o = 0; o < table.outputs.size(); ++o) {
      results.push_back(nothing_written((table.outputs[o].ray ? r : n) * table.outputs[o].width, output_types[o]));
    }
    Array<int64_t> sizes(table.sum_tensors, 0);
    for (const voronerf::ProgramSum& sum : table.sums) sizes[sum.sum] = k * sum.size;
    for (const voronerf::ProgramScatter& scatter : table.scatters) {
      const int64_t tables = strides[scatter.parameter] == 0 ? 1 : k;
      sizes[scatter.sum] = tables * d.parameters[scatter.parameter].size;
    }
    for (const int64_t size : sizes) results.push_back(nothing_written(size));
    const size_t kept = results.size();
    for (const voronerf::ProgramLookup& lookup : table.lookups) {
      results.push_back(nothing_written(plain || !keeps ? 0 : n * table.memories[lookup.memory]));
    }
    Array<const void*> in, of_cells;
    Array<void*> outputs;
    Array<float*> sums, keep;
    for (const Tensor& input : inputs) in.push_back(input.bytes.data());
    for (const Tensor& parameter : parameters) of_cells.push_back(parameter.bytes.data());
    for (size_t i = 0; i < results.size(); ++i) {
      if (i < table.outputs.size()) {
        outputs.push_back(results[i].bytes.data());
      } else {
        (i < kept ? sums : keep).push_back(reinterpret_cast<float*>(results[i].bytes.data()));
      }
    }
    const bool keeping = keeps && !plain && !keep.empty();
    voronerf::ProgramInputs given{in.data(),
                                  input_types,
                                  transposed,
                                  of_cells.data(),
                                  parameter_types,
                                  strides,
                                  offsets.data(),
                                  or_null(order),
                                  or_null(ray_index),
                                  n,
                                  r,
                                  k,
                                  keeping ? keep.data() : nullptr,
                                  !keeping,
                                  plain || keeping || !sifts ? -1 : d.gradients,
                                  "program",
                                  "ray_index"};
    const voronerf::ProgramResults to{outputs.data(), output_types, sums.data()};
    voronerf::grouped_program_cpu(*program, given, to, isa, threads);
    if (keeping && ready) {
      for (size_t i = 0; i < kept; ++i) std::fill(results[i].bytes.begin(), results[i].bytes.end(), '\xff');
      given.ready = true;
      given.gradients = sifts ? d.gradients : -1;
      voronerf::grouped_program_cpu(*program, given, to, isa, threads);
    }
    return results;
  }
};

// An instruction set and an operand layout for a program. The portable path emulates tile registers.
struct Way {
  Isa isa;
  voronerf::ProgramTable Description::* table;
};
constexpr Way kWays[] = {
    {Isa::portable, &Description::floats},   {Isa::neon, &Description::floats},
    {Isa::avx2, &Description::floats},       {Isa::avx512, &Description::floats},
    {Isa::avx512_bf16, &Description::pairs}, {Isa::portable, &Description::tiles},
    {Isa::portable, &Description::parts},    {Isa::amx, &Description::tiles},
    {Isa::amx, &Description::parts},
};

void run_case(const Description& description, int number) {
  for (const Way& way : kWays) {
    const voronerf::ProgramTable& table = description.*way.table;
    if (!voronerf::isa_supported(way.isa)) continue;
    const bool rounds = way.table == &Description::pairs || way.table == &Description::tiles;
    const bool first = way.isa == Isa::portable && way.table == &Description::floats;
    for (const bool plain : {true, false}) {
      start_case(number + 1, first && plain);
      const Case one(description);
      const Array<Tensor> alone = one.run(way.isa, table, 1, plain), together = one.run(way.isa, table, 3, plain);
      const std::string name = "program " + std::to_string(number) + ", instruction set " +
                               std::to_string(static_cast<int>(way.isa)) + ", layout " +
                               std::to_string(static_cast<int>(table.layout)) + (plain ? "" : ", as drawn");
      for (size_t i = 0; i < alone.size(); ++i) {
        const std::string what = name + ", result " + std::to_string(i);
        same(alone[i].bytes, together[i].bytes, what.c_str());
        const Array<float> values = widened(alone[i]);
        for (const float value : values) {
          if (!std::isfinite(value)) fail(what + " is not finite");
        }
        if (i + description.floats.lookups.size() >= alone.size()) continue;  // stored lookups are not compared
        // Programs with all kinds of steps may subtract values rounded to bfloat16, with a large relative error.
        const double pairs = number % 4 < 2 ? 0.2 : 0.5;
        like_portable(values, what.c_str(), rounds ? pairs : one.tolerance);
      }
    }
  }
}

}  // namespace

int main(int count, char** arguments) {
  if (count < 3) fail("programs CASES FILE [FIRST], with what programs.py wrote");
  const int programs = 4 * std::atoi(arguments[1]), first = count > 3 ? 4 * std::atoi(arguments[3]) : 0;
  file.open(arguments[2]);
  for (int i = 0; i < programs; ++i) run_case(next(), first + i);
  std::printf("%d programs\n", programs);
  return 0;
}
