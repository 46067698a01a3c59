// An index of centres: a tree of boxes in which nearest_centre finds the same centre as a search of all centres.
//
// It has 2^bits leaves of at most 16 centres. The leaves come from `bits` levels of splits at the median of the longest
// axis (Bentley, "Multidimensional binary search trees", 1975). Four levels of splits make one node, which holds the
// boxes of its 16 children, axis by axis. The root has the remaining 1 to 4 levels. A leaf holds the coordinates of its
// centres, axis by axis, then their numbers. The layout follows from k: a head that describes the centres, nodes level
// by level, leaves. For three coordinates of float32 it takes 18 bytes a centre if k is a power of two, and 36 if k is
// one more than a power of two.
#pragma once

#include <cstdint>

#include "common/hd.h"
#include "common/isa.h"

namespace voronerf {

constexpr int kWide = 16;       // children of a node, centres of a leaf
constexpr int kMostLevels = 7;  // levels of nodes, above up to 2^27 leaves
constexpr int kMostAxes = 4;
constexpr int kHead = 16;  // words of the head

struct CentreIndexShape {
  int64_t k, leaves, words;  // words: size in int32
  int bits, levels, node_words, leaf_words;
  int64_t level_word[kMostLevels + 1];  // first word of the nodes of each level, then of the leaves
};

// Returns the number of split levels in the root, 0 if the index is one leaf.
VN_HD int root_bits(int bits) { return bits == 0 ? 0 : (bits - 1) % 4 + 1; }

VN_HD CentreIndexShape centre_index_shape(int64_t k, int d, int bytes) {
  CentreIndexShape shape{};
  shape.k = k;
  while (int64_t{kWide} << shape.bits < k) ++shape.bits;
  shape.leaves = int64_t{1} << shape.bits;
  shape.levels = (shape.bits + 3) / 4;
  shape.node_words = 2 * d * kWide * (bytes / 4);
  shape.leaf_words = kWide * (d * (bytes / 4) + 1);
  int64_t nodes = 1, word = kHead;
  for (int level = 0; level < shape.levels; ++level) {
    shape.level_word[level] = word;
    word += nodes * shape.node_words;
    nodes <<= level == 0 ? root_bits(shape.bits) : 4;
  }
  shape.level_word[shape.levels] = word;
  shape.words = word + shape.leaves * shape.leaf_words;
  return shape;
}

// Returns whether an index describes k centres with d coordinates of `bytes` bytes each.
VN_HD bool is_index_of(const int32_t* index, int64_t k, int d, int bytes) {
  return index[0] == static_cast<int32_t>(k) && index[1] == d && index[2] == bytes;
}

// Returns the index's size in int32 for k centres with d coordinates of `bytes` bytes each.
int64_t centre_index_words(int64_t k, int d, int bytes);

// Fills an index of centres [k,d], d = 1 to 4. The result does not depend on the number of threads.
template <typename T>
void index_centres_cpu(const T* centres, int32_t* index, int64_t k, int d, int threads);

// Writes the nearest centre of each of the points [n,d] to cells [n], on the calling thread.
VN_DECLARE_FOR_ISA(void search_index(const float* points, const int32_t* index, int32_t* cells, int64_t n,
                                     const CentreIndexShape& shape, int d))
VN_DECLARE_FOR_ISA(void search_index(const double* points, const int32_t* index, int32_t* cells, int64_t n,
                                     const CentreIndexShape& shape, int d))

}  // namespace voronerf
