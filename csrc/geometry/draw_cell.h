// A leaf for each point, drawn by its distances: points [n,3] go down a tree of diagrams (tables as in locate_cell.h),
// and at each level a centre of the diagram reached is drawn with a probability in proportion to
//
//     exp(-d / temperature),    d = |x - c|, with power weights sqrt(|x - c|^2 + max w - w)
//
// by the inverse of the distribution: with u = uniforms[point, level] in 0 to 1 it is the first centre up to which the
// probabilities sum to at least 1 - u. Float32 throughout; a centre less likely than the nearest by a factor of
// e^20 is never drawn. A point that is not finite takes the first centre at every level.
#pragma once

#include <cstdint>

#include "common/isa.h"

namespace voronerf {

// int32 and float32 elements of workspace for a number of threads and m centres, the former from an address that 8
// divides.
int64_t draw_cell_places(int64_t m, int threads);
int64_t draw_cell_sums(int64_t m, int threads);

// uniforms [n,depth]; weights [m] or null. The tables are sound (locate_cell_fault). False if a point is not at a leaf
// after `depth` levels.
bool draw_cell_cpu(const float* points, const float* centres, const float* weights, const int32_t* child_offsets,
                   const int32_t* child, const float* uniforms, int32_t* leaves, int32_t* places, float* sums,
                   int64_t n, int64_t m, int depth, double temperature, Isa isa, int threads);

// g diagrams. For unsound tables see locate_cell_cuda.
void draw_cell_cuda(const float* points, const float* centres, const float* weights, const int32_t* child_offsets,
                    const int32_t* child, const float* uniforms, int32_t* leaves, int64_t n, int64_t m, int64_t g,
                    int depth, double temperature, void* stream);

// One diagram of k centres for n points: uniforms [n] -> cells [n]. sums: kDrawLanes * k floats.
constexpr int kDrawLanes = 16;
VN_DECLARE_FOR_ISA(void draw_cell(const float* points, const float* centres, const float* weights,
                                  const float* uniforms, float temperature, float inverse, float* sums, int32_t* cells,
                                  int64_t n, int64_t k))

}  // namespace voronerf
