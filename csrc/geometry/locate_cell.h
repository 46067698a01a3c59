// The nested query: points [n,3] go down a tree of diagrams to a leaf, leaves [n].
//
// Diagram j owns rows child_offsets[j] : child_offsets[j+1] of centres [m,3]; diagram 0 is the root. child[c] >= 0:
// centre c is refined by diagram child[c]; child[c] < 0: centre c is leaf -child[c] - 1. `depth` is the number of
// levels. Each level finds the nearest centre as nearest_centre.h does.
#pragma once

#include <cstdint>

#include "common/isa.h"
#include "common/row_count.h"

namespace voronerf {

// Returns null if the tables of g diagrams are valid, else the broken rule, for an error message after "locate_cell: ".
const char* locate_cell_fault(const int32_t* child_offsets, const int32_t* child, int64_t g, int64_t m);

// Returns the workspace's size in int32 for `threads` threads and m centres. The workspace is aligned to 8 bytes.
int64_t locate_cell_workspace(int64_t m, int threads);

// Requires valid tables (locate_cell_fault). Returns false if a point is not at a leaf after `depth` levels.
template <typename T>
bool locate_cell_cpu(const T* points, const T* centres, const int32_t* child_offsets, const int32_t* child,
                     int32_t* leaves, int32_t* workspace, RowCount n, int64_t m, int depth, Isa isa, int threads);

// g is the number of diagrams. Invalid tables (locate_cell_fault) cannot be rejected without a host read. A point's
// walk ends where a table entry is out of range, so that nothing outside is read. A point gets a negative number if its
// walk ends without a leaf or takes more than `depth` levels. rows: [1], the number of leading points to locate (other
// points get -1), or null to locate all points.
template <typename T>
void locate_cell_cuda(const T* points, const T* centres, const int32_t* child_offsets, const int32_t* child,
                      const int32_t* rows, int32_t* leaves, int64_t n, int64_t m, int64_t g, int depth, void* stream);

}  // namespace voronerf
