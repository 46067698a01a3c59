// An index of centres: a tree of boxes in which nearest_centre finds the same centre as by all of them.
//
// 2^bits leaves of at most 16 centres, by bits splits at the median of the longest axis (Bentley, "Multidimensional
// binary search trees", 1975), of which four at a time are one node: it holds the boxes of its 16 children, one axis
// after another, as a leaf holds the coordinates of its centres and then their numbers. The root has the splits that
// four do not divide. Where everything lies follows from k: a head that says what the index is of, nodes level by
// level, leaves. In three coordinates of float32 that is 18 bytes a centre where k is a power of two, and 36 where it
// is one more.
#pragma once

#include <cstdint>

#include "common/hd.h"
#include "common/isa.h"

namespace voronerf {

constexpr int kWide = 16;       // children of a node, centres of a leaf
constexpr int kMostLevels = 7;  // of nodes, above 2^27 leaves
constexpr int kMostAxes = 4;
constexpr int kHead = 16;  // words

struct CentreIndexShape {
  int64_t k, leaves, words;  // words: int32 of memory
  int bits, levels, node_words, leaf_words;
  int64_t level_word[kMostLevels + 1];  // where the nodes of each level begin, and after the last level the leaves
};

// Splits of the root, from 0 where a leaf is all.
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

// Whether an index is of k centres of d coordinates of so many bytes.
VN_HD bool is_index_of(const int32_t* index, int64_t k, int d, int bytes) {
  return index[0] == static_cast<int32_t>(k) && index[1] == d && index[2] == bytes;
}

// int32 of memory for k centres of d coordinates of so many bytes.
int64_t centre_index_words(int64_t k, int d, int bytes);

// Fills an index of centres [k,d], d = 1 to 4; the same for any number of threads.
template <typename T>
void index_centres_cpu(const T* centres, int32_t* index, int64_t k, int d, int threads);

// Whether two arrays hold the same bits.
bool same_bits(const float* one, const float* other, int64_t count);

// The cells of points [n,d], as nearest_centre gives them, on the calling thread.
VN_DECLARE_FOR_ISA(void search_index(const float* points, const int32_t* index, int32_t* cells, int64_t n,
                                     const CentreIndexShape& shape, int d))
VN_DECLARE_FOR_ISA(void search_index(const double* points, const int32_t* index, int32_t* cells, int64_t n,
                                     const CentreIndexShape& shape, int d))

}  // namespace voronerf
