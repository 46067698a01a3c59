// The nested query: points [n,3] go down a tree of diagrams to a leaf, leaves [n].
//
// Diagram j owns rows child_offsets[j] : child_offsets[j+1] of centres [m,3]; diagram 0 is the root. child[c] >= 0:
// centre c is refined by diagram child[c]; child[c] < 0: centre c is leaf -child[c] - 1.
// `depth` is the number of levels. At each level the nearest centre is that of nearest_centre.h.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "common/row_count.h"

namespace voronerf {

// Null if the tables are sound, else the rule that they break, for an error after "locate_cell: ". g diagrams.
const char* locate_cell_fault(const int32_t* child_offsets, const int32_t* child, int64_t g, int64_t m);

// int32 elements of workspace for a number of threads and m centres, from an address that 8 divides.
int64_t locate_cell_workspace(int64_t m, int threads);

// The tables are sound (locate_cell_fault). False if a point is not at a leaf after `depth` levels.
template <typename T>
bool locate_cell_cpu(const T* points, const T* centres, const int32_t* child_offsets, const int32_t* child,
                     int32_t* leaves, int32_t* workspace, RowCount n, int64_t m, int depth, Isa isa, int threads);

// g diagrams. Unsound tables (locate_cell_fault) cannot be refused without a host read: a walk ends where they lead out
// of them, nothing outside is read, and a point that has reached no leaf by then, or in `depth` levels, gets a negative
// number. rows: [1], how many points count, the others get -1; null for all.
template <typename T>
void locate_cell_cuda(const T* points, const T* centres, const int32_t* child_offsets, const int32_t* child,
                      const int32_t* rows, int32_t* leaves, int64_t n, int64_t m, int64_t g, int depth, void* stream);

}  // namespace voronerf
