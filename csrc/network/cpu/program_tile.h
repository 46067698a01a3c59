// The steps of a program on a tile of rows; see program_isa.cpp.
#pragma once

#include "network/cpu/activation_tile.h"
#include "network/cpu/few_outputs_tile.h"
#include "network/cpu/functions_tile.h"
#include "network/cpu/gemm_tile.h"
#include "network/cpu/grouped_mlp_pack.h"
#include "network/cpu/program_code.h"

namespace voronerf {
namespace VN_ISA_NAMESPACE {
namespace {

// Columns of a value or of a vector: rows of `stride` floats, 0 where they are all the same.
struct Rows {
  const float* data;
  int64_t stride;
  bool spread;
  VN_INLINE F32 vector(const Rows& rows, int64_t row, int64_t column) {
    const float* from = rows.data + row * rows.stride;
    return rows.spread ? splat(*from) : load(from + column);
  }
};

// to = body(x, y), for `width` columns rounded up to whole vectors.
template <typename Body>
VN_INLINE void each(float* to, int64_t stride, int64_t rows, const Rows& x, const Rows& y, const Body& body) {
  const bool flat = !x.spread && !y.spread && x.stride == stride && y.stride == stride;
  if (flat) {
    for (int64_t i = 0; i < rows * stride; i += kLanes) store(to + i, body(load(x.data + i), load(y.data + i)));
    return;
  }
  for (int64_t row = 0; row < rows; ++row) {
    for (int64_t c = 0; c < stride; c += kLanes) {
      store(to + row * stride + c, body(Rows::vector(x, row, c), Rows::vector(y, row, c)));
    }
  }
}

template <typename Function, int Order>
void apply_order(float* to, int64_t stride, int64_t rows, const Rows& x, const Rows* times, float a, float b) {
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
void apply_function(int order, float* to, int64_t stride, int64_t rows, const Rows& x, const Rows* times,
                    const float* numbers) {
  const float a = numbers[0], b = numbers[1];
  switch (order) {
    case 0:
      return apply_order<Function, 0>(to, stride, rows, x, times, a, b);
    case 1:
      return apply_order<Function, 1>(to, stride, rows, x, times, a, b);
    case 2:
      return apply_order<Function, 2>(to, stride, rows, x, times, a, b);
    default:
      return apply_order<Function, 3>(to, stride, rows, x, times, a, b);
  }
}

// Rows of one tile.
struct ProgramTile {
  const ProgramCall& call;
  const ProgramHeader& header;
  const float* packed;
  float* tiles;
  float* partial;
  int64_t begin, rows;
  bool fill;  // the first tile of a task

  const ProgramPack* packs() const {
    return reinterpret_cast<const ProgramPack*>(call.code + sizeof(ProgramHeader) / 4);
  }
  float* at(int32_t slot) const { return tiles + int64_t{slot} * call.tile; }
  Rows operand(const ProgramOperand& o) const {
    if (o.parameter) return {packed + packs()[o.slot].at, 0, o.spread != 0};
    return {at(o.slot) + o.start, o.stride, o.spread != 0};
  }
  int64_t place(int64_t row) const { return call.order == nullptr ? begin + row : call.order[begin + row]; }

  void run() const {
    const int32_t* code = reinterpret_cast<const int32_t*>(packs() + header.packs);
    for (int32_t i = 0; i < header.steps; ++i) {
      const ProgramStep& step = *reinterpret_cast<const ProgramStep*>(code);
      const auto* operands = reinterpret_cast<const ProgramOperand*>(code + sizeof(ProgramStep) / 4);
      run_step(step, operands);
      code = reinterpret_cast<const int32_t*>(operands + step.count);
    }
  }

  void run_step(const ProgramStep& step, const ProgramOperand* operands) const {
    float* const to = at(step.slot);
    const int64_t stride = step.stride, width = step.width;
    switch (step.op) {
      case kProgramInput: {
        const float* from = call.inputs[step.number];
        if (call.turned[step.number]) return turn(from, step);
        if (call.order == nullptr && width == stride) {
          __builtin_memcpy(to, from + begin * width, sizeof(float) * rows * width);
          return;
        }
        for (int64_t row = 0; row < rows; ++row) copy_row(from + place(row) * width, width, to + row * stride);
        return;
      }
      case kProgramOutput: {
        const Rows x = operand(operands[0]);
        float* out = call.outputs[step.number];
        for (int64_t row = 0; row < rows; ++row) {
          const float* from = x.data + row * x.stride;
          float* into = out + place(row) * width;
          if (x.spread) {
            for (int64_t c = 0; c < width; ++c) into[c] = *from;
          } else {
            copy_row(from, width, into);
          }
        }
        return;
      }
      case kProgramLinear:
        return linear(step, operands);
      case kProgramFunction: {
        const Rows x = operand(operands[0]), times = step.count > 1 ? operand(operands[1]) : x;
        const Rows* by = step.count > 1 ? &times : nullptr;
        const float* numbers = call.constants + step.constants;
        switch (step.name) {
#define VN_CASE(NAME, ...) \
  case kFunction_##NAME:   \
    return apply_function<NAME##_function>(step.order, to, stride, rows, x, by, numbers);
          VN_FUNCTIONS(VN_CASE)
#undef VN_CASE
        }
        return;
      }
      case kProgramBinary: {
        const Rows x = operand(operands[0]), y = operand(operands[1]);
        const F32 zero = splat(0.0f);
        if (step.name == kProgramAdd) return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a + b; });
        if (step.name == kProgramSub) return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a - b; });
        if (step.name == kProgramMul) return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a * b; });
        if (step.name == kProgramDiv) return each(to, stride, rows, x, y, [](F32 a, F32 b) { return a / b; });
        return each(to, stride, rows, x, y, [=](F32 a, F32 b) { return b == zero ? zero : a; });
      }
      case kProgramTotal:
        return total(step, operand(operands[0]));
      case kProgramMove:
        return move(step, operands);
      default:
        return sum(step, operands);
    }
  }

  // Columns [width][n] as rows.
  void turn(const float* from, const ProgramStep& step) const {
    float* const to = at(step.slot);
    int64_t c = 0;
    for (; call.order == nullptr && c + 4 <= step.width; c += 4) {
      transpose_four(from + c * call.n + begin, call.n, rows, to + c, step.stride);
    }
    for (; c < step.width; ++c) {
      for (int64_t row = 0; row < rows; ++row) to[row * step.stride + c] = from[c * call.n + place(row)];
    }
  }

  void linear(const ProgramStep& step, const ProgramOperand* operands) const {
    const Rows x = operand(operands[0]);
    const bool added = step.count > 1 + (step.finish == 2);
    const Rows add = added ? operand(operands[1]) : Rows{kZeros, 0, false};
    const float* slope = step.finish == 2 ? operand(operands[step.count - 1]).data : nullptr;
    const Finish finish = step.finish == 0 ? Finish::none : step.finish == 1 ? Finish::relu : Finish::relu_slope;
    const Source source{x.data, x.stride, step.depth};
    const float* const weights = packed + packs()[step.number].at;
    float* const to = at(step.slot);
    if (step.order > 0) {
      const auto product = step.order == 1 ? few_outputs<1> : few_outputs<4>;
      return product(&source, 1, weights, step.depth, add.data, step.finish == 1, rows, to);
    }
    for (int64_t first = 0; first < step.stride; first += kPanel) {
      const int64_t columns = smaller(kPanel, step.stride - first);
      const float* start = add.data == kZeros ? kZeros : add.data + first;
      multiply<false>({&source, 1, weights + first * step.depth, columns, start, add.stride, to + first, step.stride,
                       finish, slope == nullptr ? nullptr : slope + first, nullptr, 0},
                      rows, columns);
    }
  }

  void total(const ProgramStep& step, const Rows& x) const {
    float* to = at(step.slot);
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

  void move(const ProgramStep& step, const ProgramOperand* operands) const {
    float* const to = at(step.slot);
    if (step.order == 0) {  // something is added up, or left out
      for (int64_t i = 0; i < rows * step.stride; i += kLanes) store(to + i, splat(0.0f));
    }
    for (int32_t i = 0; i < step.count; ++i) {
      const Rows x = operand(operands[i]);
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

  void sum(const ProgramStep& step, const ProgramOperand* operands) const {
    float* const to = partial + step.number;
    const Rows g = operand(operands[0]);
    if (step.op == kProgramColumns) {
      for (int64_t c = 0; c < step.stride; c += kLanes) {
        F32 sums[4] = {fill ? splat(0.0f) : load(to + c), splat(0.0f), splat(0.0f), splat(0.0f)};
        const float* from = g.data + c;
        int64_t row = 0;
        for (; row + 4 <= rows; row += 4) {
          for (int i = 0; i < 4; ++i, from += g.stride) sums[i] = sums[i] + load(from);
        }
        for (; row < rows; ++row, from += g.stride) sums[0] = sums[0] + load(from);
        store(to + c, (sums[0] + sums[1]) + (sums[2] + sums[3]));
      }
      return;
    }
    const Rows x = operand(operands[1]);
    const Rows& a = step.depth ? g : x;
    const Rows& b = step.depth ? x : g;
    const Source source{a.data, a.stride, rows};
    const int64_t of_a = step.depth ? operands[0].width : operands[1].width;
    for (int64_t first = 0; first < step.stride; first += kPanel) {
      float* c = to + first;
      multiply<true>({&source, 1, b.data + first, b.stride, fill ? kZeros : c, fill ? 0 : step.stride, c, step.stride,
                      Finish::none, nullptr, nullptr, 0},
                     of_a, smaller(kPanel, step.stride - first));
    }
  }
};

}  // namespace
}  // namespace VN_ISA_NAMESPACE
}  // namespace voronerf
