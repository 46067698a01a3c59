// The steps of a program on a tile of rows; see program_isa.cpp.
#pragma once

#include "encoding/by_row_tile.h"
#include "encoding/hash_encode_isa.h"
#include "network/cpu/functions_tile.h"
#include "network/cpu/program_pack.h"
#include "network/cpu/program_rows_tile.h"
#if VN_HALF == 2
#include "network/cpu/gemm_tiles.h"
#else
#include "network/cpu/few_outputs_tile.h"
#endif

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Computes to = body(x, y) elementwise, for all `stride` columns including the padding.
template <typename Body>
VN_INLINE void each(float* to, int64_t stride, int64_t rows, const Operand& x, const Operand& y, const Body& body) {
  const bool flat = !x.spread && !y.spread && x.stride == stride && y.stride == stride;
  if (flat) {
    for (int64_t i = 0; i < rows * stride; i += kLanes) store(to + i, body(load(x.data + i), load(y.data + i)));
    return;
  }
  for (int64_t row = 0; row < rows; ++row) {
    for (int64_t c = 0; c < stride; c += kLanes) {
      store(to + row * stride + c, body(Operand::vector(x, row, c), Operand::vector(y, row, c)));
    }
  }
}

template <typename Function, int Order>
void apply_order(float* to, int64_t stride, int64_t rows, const Operand& x, const Operand* times, float a, float b) {
  if (times == nullptr) {
    each(to, stride, rows, x, x, [=](F32 v, F32) { return Function::template at<Order>(v, a, b); });
  } else {
    each(to, stride, rows, x, *times, [=](F32 v, F32 g) {
      const F32 slope = Function::template at<Order>(v, a, b);
      return g * slope;
    });
  }
}

template <typename Function>
void apply_function(const ProgramStep& step, float* to, int64_t rows, const Operand& x, const Operand* times) {
  const int64_t stride = step.stride;
  switch (step.order) {
    case 0:
      return apply_order<Function, 0>(to, stride, rows, x, times, step.a, step.b);
    case 1:
      return apply_order<Function, 1>(to, stride, rows, x, times, step.a, step.b);
    case 2:
      return apply_order<Function, 2>(to, stride, rows, x, times, step.a, step.b);
    default:
      return apply_order<Function, 3>(to, stride, rows, x, times, step.a, step.b);
  }
}

// Runs a program on the rows of one tile.
struct ProgramTile {
  const CpuProgram& call;
  const float* packed;
  float* tiles;
  float* partial;
  int64_t cell, begin, rows;
  bool fill;  // the first tile of a task

  const ProgramPack& pack(int32_t number) const { return call.code.packs[number]; }
  float* slot(int32_t columns) const { return tiles + int64_t{columns} * call.tile; }
  float* at(int32_t columns, int32_t memory, int64_t stride) const {
    float* const kept = memory < 0 ? nullptr : call.memories[memory];
    return kept == nullptr ? slot(columns) : kept + begin * stride;
  }
  Operand operand(const ProgramOperand& o) const {
    if (o.parameter) return {packed + pack(o.slot).at, 0, o.spread};
    if (o.input >= 0 && call.in_place[o.input]) {
      const int64_t width = call.input_widths[o.input];
      return {static_cast<const float*>(call.inputs[o.input]) + begin * width + o.start, width, o.spread};
    }
    return {at(o.slot, o.memory, o.stride) + o.start, o.stride, o.spread};
  }
  int64_t place(int64_t row) const { return call.order == nullptr ? begin + row : call.order[begin + row]; }
  float* scratch(int part) const { return slot(call.code.scratch + part * call.code.scratch_width); }

  void run() const {
    for (int32_t i = 0; i < call.code.step_count; ++i) {
      const ProgramStep& step = call.code.steps[i];
      float* const to = at(step.slot, step.memory, step.stride);
      run_step(step, call.code.operands + step.first, to);
#if VN_HALF == 2
      if (step.pairs >= 0 && narrows(step)) {
        narrow_rows(result_of(step, to), step.width, rows, slot(step.pairs), stride_of(step.width),
                    left_of(step.width));
      }
#endif
    }
  }

  // Returns the result of a step, or the step's input if the input is read in place.
  Operand result_of(const ProgramStep& step, const float* to) const {
    if (step.op != ProgramOp::input || !step.in_place || !call.in_place[step.number]) return {to, step.stride, false};
    return {static_cast<const float*>(call.inputs[step.number]) + begin * step.width, step.width, false};
  }

  // Returns whether a step's value must be narrowed to pairs after the step.
  bool narrows(const ProgramStep& step) const {
    if (step.op == ProgramOp::input) return !narrowed_as_read(step);
    return step.op != ProgramOp::linear && step.op != ProgramOp::encode;
  }
  bool narrowed_as_read(const ProgramStep& step) const {
    return step.pairs >= 0 && !call.transposed[step.number] && !call.parts;
  }

  void run_step(const ProgramStep& step, const ProgramOperand* operands, float* to) const {
    const int64_t stride = step.stride;
    switch (step.op) {
      case ProgramOp::input:
        return input(step, to);
      case ProgramOp::output:
        return output(step, operands[0]);
      case ProgramOp::linear:
        return linear(step, operands, to);
      case ProgramOp::function: {
        const Operand x = operand(operands[0]), times = step.operand_count > 1 ? operand(operands[1]) : x;
        const Operand* by = step.operand_count > 1 ? &times : nullptr;
        switch (step.function) {
#define VN_CASE(NAME, ...)    \
  case ProgramFunction::NAME: \
    return apply_function<NAME##_function>(step, to, rows, x, by);
          VN_FUNCTIONS(VN_CASE)
#undef VN_CASE
        }
        return;
      }
      case ProgramOp::binary: {
        const Operand x = operand(operands[0]), y = operand(operands[1]);
        const F32 zero = splat(0.0f);
        switch (step.binary) {
          case ProgramBinary::add:
            return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a + b; });
          case ProgramBinary::sub:
            return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a - b; });
          case ProgramBinary::mul:
            return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a * b; });
          case ProgramBinary::div:
            return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a / b; });
          case ProgramBinary::gate:
            return each(to, stride, rows, x, y, [=](F32 a, F32 b) { return b == zero ? zero : a; });
        }
        return;
      }
      case ProgramOp::total:
        return total(step, operand(operands[0]), to);
      case ProgramOp::move:
        return move(step, operands, to);
      case ProgramOp::encode:
        switch (step.encoding) {
#define VN_CASE(NAME, ...)    \
  case ProgramEncoding::NAME: \
    return encode_by(__VA_ARGS__(), step, operands, to);
          VN_ENCODINGS(VN_CASE)
#undef VN_CASE
          case ProgramEncoding::hash:
            return look_up(step, operands, to);
        }
        return;
      case ProgramOp::outer:
        return outer(step, operands);
      case ProgramOp::columns:
        return columns(step, operands[0]);
    }
  }

  void input(const ProgramStep& step, float* to) const {
    const int32_t number = step.number;
    const int64_t stride = step.stride, width = step.width;
    const auto row_of = [&](int64_t row) {
      const int64_t sample = place(row);
      return call.rays[number] ? call.ray_index[sample] : sample;
    };
#if VN_HALF == 2
    if (narrowed_as_read(step)) {
      float* pairs = slot(step.pairs);
      for (int64_t row = 0; row < rows; ++row, pairs += pairs_of(width)) {
        if (call.input_types[number] == TableType::bfloat16) {
          copy_pairs(static_cast<const uint16_t*>(call.inputs[number]) + row_of(row) * width, width, pairs);
        } else {
          narrow_row(static_cast<const float*>(call.inputs[number]) + row_of(row) * width, width, pairs);
        }
      }
      if (!step.floats) return;
    }
#endif
    if (step.in_place && call.in_place[number]) return;
    if (step.points && call.looked_up) return;
    if (call.transposed[number]) return turn(static_cast<const float*>(call.inputs[number]), step, to);
    if (call.input_types[number] == TableType::bfloat16) {
      const auto* from = static_cast<const uint16_t*>(call.inputs[number]);
      if (width == stride && call.order == nullptr && !call.rays[number]) {
        return widen_row(from + begin * width, rows * width, to);
      }
      for (int64_t row = 0; row < rows; ++row) widen_row(from + row_of(row) * width, width, to + row * stride);
      return;
    }
    const auto* from = static_cast<const float*>(call.inputs[number]);
    if (call.in_place[number] && width == stride) {
      __builtin_memcpy(to, from + begin * width, sizeof(float) * rows * width);
      return;
    }
    // The processor cannot predict the addresses of gathered rows, so wide rows are prefetched this many rows ahead.
    // With 63 features, gathered rows take 1.24 times as long as sorted rows without prefetching, and 1.04 times as
    // long with prefetching and whole vectors.
    constexpr int64_t kAhead = 8;
    const bool scattered = call.order != nullptr && width >= kGranule;
    for (int64_t row = 0; row < rows; ++row) {
      if (scattered && row + kAhead < rows) {
        const float* next = from + row_of(row + kAhead) * width;
        for (int64_t c = 0; c < width; c += 16) __builtin_prefetch(next + c);
      }
      copy_row(from + row_of(row) * width, width, to + row * stride);
    }
  }

  // Transposes an input [width][n] to rows.
  void turn(const float* from, const ProgramStep& step, float* to) const {
    int64_t c = 0;
    for (; call.order == nullptr && c + 4 <= step.width; c += 4) {
      transpose_four(from + c * call.n + begin, call.n, rows, to + c, step.stride);
    }
    for (; c < step.width; ++c) {
      for (int64_t row = 0; row < rows; ++row) to[row * step.stride + c] = from[c * call.n + place(row)];
    }
  }

  void output(const ProgramStep& step, const ProgramOperand& from) const {
    const Operand x = operand(from);
    if (x.data == static_cast<float*>(call.outputs[step.number]) + begin * step.width) return;  // in place
    const int64_t width = step.width, row_width = call.output_widths[step.number];
    float* const summed = step.memory < 0 ? nullptr : call.memories[step.memory];  // rows of a ray output
    const bool half = call.output_types[step.number] == TableType::bfloat16;
    if (summed == nullptr && !half && !x.spread) {
      float* const out = static_cast<float*>(call.outputs[step.number]) + step.depth;
      const float* values = x.data;
      for (int64_t row = 0; row < rows; ++row, values += x.stride)
        copy_row(values, width, out + place(row) * row_width);
      return;
    }
    for (int64_t row = 0; row < rows; ++row) {
      const float* values = x.data + row * x.stride;
      const int64_t to = (summed == nullptr ? place(row) : begin + row) * row_width + step.depth;
      if (half && summed == nullptr) {
        uint16_t* const into = static_cast<uint16_t*>(call.outputs[step.number]) + to;
        round_row(values, x.spread ? 1 : width, into);
        for (int64_t c = 1; x.spread && c < width; ++c) into[c] = into[0];
        continue;
      }
      float* const into = (summed == nullptr ? static_cast<float*>(call.outputs[step.number]) : summed) + to;
      if (x.spread) {
        for (int64_t c = 0; c < width; ++c) into[c] = *values;
      } else {
        copy_row(values, width, into);
      }
    }
  }

  void linear(const ProgramStep& step, const ProgramOperand* operands, float* to) const {
    const bool slopes = step.finish == ProgramFinish::relu_slope;
    const int32_t count = step.sources;
    const Operand add = step.operand_count > count + slopes ? operand(operands[count]) : Operand{kZeros, 0, false};
    const float* slope = slopes ? operand(operands[step.operand_count - 1]).data : nullptr;
    const Finish finish = step.finish == ProgramFinish::none   ? Finish::none
                          : step.finish == ProgramFinish::relu ? Finish::relu
                                                               : Finish::relu_slope;
    const float* const weights = packed + pack(step.number).at;
    const int64_t depth = steps_of(step.depth), panels = call.parts ? 2 : 1;
    LeftPart sources[kMostSources];
    for (int32_t i = 0; i < count; ++i) {
      const Operand x = operand(operands[i]);
      sources[i] = {x.data, x.stride, steps_of(operands[i].width)};
    }
    float* const pairs = step.pairs < 0 ? nullptr : slot(step.pairs);
    const int64_t pairs_stride = stride_of(step.width), pairs_left = left_of(step.width);
    bool slope_in_pairs = false;
#if VN_HALF
    const Operand x = in_pairs(operands[0], scratch(0));
    sources[0].data = x.data;  // with pairs there is one source
    sources[0].stride = x.stride;
#endif
#if VN_HALF == 2
    if (slopes && operands[step.operand_count - 1].pairs >= 0) {
      slope = slot(operands[step.operand_count - 1].pairs);
      slope_in_pairs = true;
    }
#endif
#if VN_HALF < 2
    if (step.order > 0) {
      const auto product = step.order == 1 ? few_outputs<1> : few_outputs<4>;
      return product(sources, count, weights, depth, add.data, step.finish == ProgramFinish::relu, rows, to);
    }
#endif
    float* const c = pairs == nullptr || step.floats ? to : nullptr;
    for (int64_t first = 0; first < step.stride; first += kPanel) {
      const int64_t columns = smaller(kPanel, step.stride - first);
      const auto from = [=](float* at, bool of_pairs) {
        return at == nullptr ? at : at + (of_pairs ? first / 2 : first);
      };
      const float* start = add.data == kZeros ? kZeros : add.data + first;
      const float* by = slope == nullptr ? nullptr : slope + (slope_in_pairs ? first / 2 : first);
      const Product product{sources,
                            count,
                            weights + panels * first * depth,
                            columns,
                            start,
                            add.stride,
                            from(c, false),
                            step.stride,
                            finish,
                            by,
                            from(pairs, true),
                            pairs_stride,
                            slope_in_pairs,
                            left_of(step.depth),
                            call.parts ? depth * columns : 0,
                            pairs_left};
#if VN_HALF == 2
      multiply_tiles(product, rows, columns);
#else
      multiply<false>(product, rows, columns);
#endif
    }
#if VN_HALF == 2
    if (pairs != nullptr) clear_behind(pairs, step.width, rows, pairs_stride);
#endif
  }

  // stride_of returns the stride of rows of pairs. With call.parts, each float is split into a bfloat16 number and its
  // rounding remainder, and the remainders' pairs follow the numbers' pairs in each row. left_of returns the offset of
  // the remainders in a row (0: none).
  int64_t stride_of(int64_t width) const { return (call.parts ? 2 : 1) * pairs_of(width); }
  int64_t left_of(int64_t width) const { return call.parts ? pairs_of(width) : 0; }

#if VN_HALF
  // Returns an operand of a product as pairs: stored pairs, or pairs computed in `free`.
  Operand in_pairs(const ProgramOperand& of, float* free) const {
    const int64_t stride = stride_of(of.width);
    if (of.pairs >= 0) return {slot(of.pairs), stride, false};
    narrow_rows(operand(of), of.width, rows, free, stride, left_of(of.width));
    return {free, stride, false};
  }
#endif

  void total(const ProgramStep& step, const Operand& x, float* to) const {
    const int64_t group = step.number;
    for (int64_t row = 0; row < rows; ++row, to += step.stride) {
      const float* from = x.data + row * x.stride;
      for (int64_t m = 0; m < step.width; ++m, from += group) {
        F32 lanes = splat(0.0f);
        int64_t c = 0;
        for (; c + kLanes <= group; c += kLanes) lanes = lanes + load(from + c);
        float parts[kLanes], sum = 0.0f;
        store(parts, lanes);
        if (c > 0) {
          for (int half = kLanes / 2; half > 0; half /= 2) {
            for (int i = 0; i < half; ++i) parts[i] += parts[i + half];
          }
          sum = parts[0];
        }
        for (; c < group; ++c) sum += from[c];
        to[m] = sum;
      }
    }
  }

  void move(const ProgramStep& step, const ProgramOperand* operands, float* to) const {
    if (step.order == 0) {  // columns may have several operands, or none
      for (int64_t i = 0; i < rows * step.stride; i += kLanes) store(to + i, splat(0.0f));
    }
    for (int32_t i = 0; i < step.operand_count; ++i) {
      const Operand x = operand(operands[i]);
      const int64_t width = operands[i].width;
      float* into = to + operands[i].place;
      const float* from = x.data;
      for (int64_t row = 0; row < rows; ++row, into += step.stride, from += x.stride) {
        if (step.order == 0) {
          for (int64_t c = 0; c < width; ++c) into[c] += from[x.spread ? 0 : c];
        } else if (x.spread || width < 4) {
          for (int64_t c = 0; c < width; ++c) into[c] = from[x.spread ? 0 : c];
        } else {
          copy_row(from, width, into);
        }
      }
    }
  }

  // Encodings ---------------------------------------------------------------------------------------------------------

  // Returns rows of `d` floats contiguously, copied if necessary.
  const float* contiguous(const Operand& x, int64_t d) const {
    if (x.stride == d) return x.data;
    float* const to = scratch(0);
    for (int64_t row = 0; row < rows; ++row) copy_row(x.data + row * x.stride, d, to + row * d);
    return to;
  }

  HashEncoding grid(const ProgramStep& step, const float* points) const {
    HashEncoding encoding = call.grids[step.number];
    const int64_t bytes = call.parameter_types[step.parameter] == TableType::float32 ? 4 : 2;
    encoding.in.table =
        static_cast<const char*>(call.parameters[step.parameter]) + cell * call.strides[step.parameter] * bytes;
    encoding.in.type = call.parameter_types[step.parameter];
    encoding.in.tables = 1;
    encoding.in.positions = points;
    return encoding;
  }

  // Looks up the encoding of x or, if step.order is 1, computes the gradient with respect to x. The operands are x or,
  // for the gradient, x, the gradient with respect to the encoding, and the encoding.
  void look_up(const ProgramStep& step, const ProgramOperand* operands, float* to) const {
    const Operand x = operand(operands[0]);
    if (step.order == 0) {
      if (step.memory >= 0 && call.filled[step.memory]) return;
      return hash_encode_rows(grid(step, contiguous(x, 3)), to, step.stride, 0, rows);
    }
    const Operand g = operand(operands[1]);
    float* const points = scratch(1);
    for (int64_t row = 0; row < rows; ++row) copy_row(x.data + row * x.stride, 3, points + 3 * row);
    hash_encode_positions_backward(grid(step, points), g.data, g.stride, points, 0, rows);
    for (int64_t row = 0; row < rows; ++row) copy_row(points + 3 * row, 3, to + row * step.stride);
  }

  template <typename Formula>
  void encode_by(ByRow<Formula>, const ProgramStep& step, const ProgramOperand* operands, float* to) const {
    const Operand x = operand(operands[0]);
    const int64_t raw = operands[0].width, size = step.depth;
    if (step.order == 0) return ByRow<Formula>::values(x.data, x.stride, raw, size, rows, to, step.stride);
    const Operand g = operand(operands[1]);
    ByRow<Formula>::gradient(x.data, x.stride, raw, size, g.data, g.stride, rows, to, step.stride);
  }

  template <bool kBlurred>
  void encode_by(Octaves<kBlurred>, const ProgramStep& step, const ProgramOperand* operands, float* to) const {
    const Operand x = operand(operands[0]);
    const Columns columns{kBlurred ? operands[0].width / 2 : operands[0].width, step.depth, !kBlurred};
    const float* const table = packed + pack(step.number).at;
    const int64_t stride = step.stride;
    if (step.order == 0) {
      float* const pairs = step.pairs < 0 ? nullptr : slot(step.pairs);
      encode(x.data, x.stride, table, rows, columns, to, stride, pairs, stride_of(step.width), left_of(step.width),
             pairs == nullptr || step.floats);
      if (kBlurred) blur(x.data + columns.d, columns.d, x.stride, table, rows, to, stride);
      return;
    }
    const Operand g = operand(operands[1]), value = operand(operands[2]);
    const int64_t of_table = pack(step.number).width;
    for (int64_t row = 0; row < rows; ++row, to += stride) {
      const float *encoded = value.data + row * value.stride, *gradient = g.data + row * g.stride;
      encode_row_backward(encoded, gradient, table, of_table, columns, to);
      if (kBlurred) blur_row_backward(encoded, gradient, table, of_table, columns, to + columns.d);
    }
  }

  // Sums --------------------------------------------------------------------------------------------------------------

  void columns(const ProgramStep& step, const ProgramOperand& of) const {
    float* const to = partial + step.number;
#if VN_HALF == 2
    if (of.pairs >= 0) return add_pairs(in_pairs(of, nullptr), step.stride, rows, fill, to);
#endif
    const Operand g = operand(of);
    for (int64_t c = 0; c < step.stride; c += kLanes) {
      // Four independent sums hide the latency of additions.
      F32 sums[4] = {fill ? splat(0.0f) : load(to + c), splat(0.0f), splat(0.0f), splat(0.0f)};
      const float* from = g.data + c;
      int64_t row = 0;
      for (; row + 4 <= rows; row += 4) {
        for (int i = 0; i < 4; ++i, from += g.stride) sums[i] = sums[i] + load(from);
      }
      for (; row < rows; ++row, from += g.stride) sums[0] = sums[0] + load(from);
      store(to + c, (sums[0] + sums[1]) + (sums[2] + sums[3]));
    }
  }

  // Computes partial [a][b] += a^T b for the values of two operands, with the rows as k.
  void outer(const ProgramStep& step, const ProgramOperand* operands) const {
    float* const to = partial + step.number;
    const ProgramOperand &of_a = operands[step.order ? 0 : 1], &of_b = operands[step.order ? 1 : 0];
#if VN_HALF == 2
    const int64_t depth = pairs_of(rows);
    const LeftPart left{scratch(0), depth, depth}, right{scratch(1), padded(of_b.width), depth};
    const int64_t width = padded(of_a.width), a_left = call.parts ? width * depth : 0, b_left = depth * right.stride;
    const Operand a = in_pairs(of_a, scratch(2));
    turn_pairs(a, width, rows, scratch(0), depth);
    if (call.parts) turn_pairs(behind(a, left_of(of_a.width)), width, rows, scratch(0) + a_left, depth);
    const Operand b = in_pairs(of_b, scratch(2));
    zip_pairs(b, right.stride, rows, scratch(1));
    if (call.parts) zip_pairs(behind(b, left_of(of_b.width)), right.stride, rows, scratch(1) + b_left);
#else
    constexpr int64_t a_left = 0, b_left = 0;
    const Operand a = operand(of_a), b = operand(of_b);
    LeftPart left{a.data, a.stride, rows}, right{b.data, b.stride, rows};
#if VN_HALF
    left = {scratch(0), padded(of_a.width), (rows + 1) / 2};
    right = {scratch(1), padded(of_b.width), (rows + 1) / 2};
    interleave_columns(a, left.stride, rows, scratch(0));
    interleave_columns(b, right.stride, rows, scratch(1));
#endif
#endif
    for (int64_t first = 0; first < step.stride; first += kPanel) {
      float* c = to + first;
      const Product product{&left,
                            1,
                            right.data + first,
                            right.stride,
                            fill ? kZeros : c,
                            fill ? 0 : step.stride,
                            c,
                            step.stride,
                            Finish::none,
                            nullptr,
                            nullptr,
                            0,
                            false,
                            a_left,
                            b_left,
                            0};
      const int64_t columns = smaller(kPanel, step.stride - first);
#if VN_HALF == 2
      multiply_tiles(product, of_a.width, columns);
#else
      multiply<true>(product, of_a.width, columns);
#endif
    }
  }
};

[[maybe_unused]] void run_tiles(const CpuProgram& call, int64_t cell, int64_t begin, int64_t end, const float* packed,
                                float* tiles, float* partial) {
  for (int64_t row = begin; row < end; row += call.tile) {
    ProgramTile{call, packed, tiles, partial, cell, row, smaller(call.tile, end - row), row == begin}.run();
  }
}

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
