// balance_centres on the CPU, as one call. At the usual size (ten thousand samples, sixteen cells) it takes a few tens
// of microseconds, less than a separate call for each of its parts would. nearest_centre finds the cells. Masses are
// added in the order of the samples, and all computation on the few centres is float64 on one thread. So the result
// depends neither on the number of threads nor on the instruction set.
#include "geometry/balance_centres.h"

#include <algorithm>

#include "geometry/nearest_centre.h"

namespace voronerf {

namespace {

constexpr int64_t kSerial = 1 << 20;  // pairs of sample and centre below which threads do not pay

void weigh(const BalanceInputs& in, const float* centres, double* weights, int32_t* cells, Isa isa, int threads) {
  const int team = in.m * in.k < kSerial ? 1 : threads;
  nearest_centre_cpu<float>(in.samples, centres, nullptr, cells, in.m, in.k, 3, 0, isa, team);
  std::fill_n(weights, in.k, 0.0);
  for (int64_t i = 0; i < in.m; ++i) weights[cells[i]] += in.masses[i];
}

double squared_distance(const float* a, const float* b) {
  double sum = 0.0;
  for (int axis = 0; axis < 3; ++axis) {
    const double d = static_cast<double>(a[axis]) - b[axis];
    sum += d * d;
  }
  return sum;
}

// Finds the closest centres to centre i, nearest first, ties in the order of the centres, by insertion into a short
// list.
void find_neighbours(const BalanceInputs& in, const float* centres, int64_t i, double* distances, double* others) {
  int64_t count = 0;
  for (int64_t j = 0; j < in.k; ++j) {
    if (j == i) continue;
    const double d = squared_distance(centres + 3 * i, centres + 3 * j);
    if (count == in.neighbours && !(d < distances[count - 1])) continue;
    int64_t at = count < in.neighbours ? count++ : count - 1;
    for (; at > 0 && d < distances[at - 1]; --at) {
      distances[at] = distances[at - 1];
      others[at] = others[at - 1];
    }
    distances[at] = d;
    others[at] = static_cast<double>(j);
  }
}

}  // namespace

int64_t balance_centres_workspace(int64_t k) { return 5 * k; }

void balance_centres_cpu(const BalanceInputs& in, float* centres, double* weights, int32_t* cells, double* workspace,
                         Isa isa, int threads) {
  double *moved = workspace, *distances = moved + 3 * in.k, *others = distances + in.k;
  weigh(in, centres, weights, cells, isa, threads);
  for (int64_t step = 0; step < in.steps && in.k > 1; ++step) {
    for (int64_t i = 0; i < in.k; ++i) {
      find_neighbours(in, centres, i, distances, others);
      double heaviest = weights[i], shift[3] = {0.0, 0.0, 0.0};
      for (int64_t n = 0; n < in.neighbours; ++n) {
        const int64_t j = static_cast<int64_t>(others[n]);
        heaviest = std::max(heaviest, weights[j]);
        for (int axis = 0; axis < 3; ++axis) {
          const double way = static_cast<double>(centres[3 * j + axis]) - centres[3 * i + axis];
          shift[axis] += way * (weights[j] - weights[i]);
        }
      }
      // In a neighbourhood without weight all differences are zero.
      const double scale = heaviest > 0.0 ? in.alpha / (heaviest * static_cast<double>(in.neighbours)) : 0.0;
      for (int axis = 0; axis < 3; ++axis) moved[3 * i + axis] = centres[3 * i + axis] + scale * shift[axis];
    }
    for (int64_t e = 0; e < 3 * in.k; ++e) centres[e] = static_cast<float>(moved[e]);
    weigh(in, centres, weights, cells, isa, threads);
  }
}

}  // namespace voronerf
