// A tree of boxes, kFan in a box: solids come in an order in which those that stand together follow each other, so that
// boxes around kFan of them, and around kFan of these, need no other arrangement, and are made again in every call. A
// ray goes down to the nearest box first, and leaves out boxes behind what it has hit: results are those of testing all
// solids. On one thread, since pictures are drawn by several.
#include "rays/first_solid.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

namespace voronerf {
namespace {

constexpr int64_t kFan = 8;
constexpr int kStack = 128;  // kFan boxes on each of 11 levels, for 2^31 solids
constexpr int kTraceSteps = 40;
constexpr float kSurface = 5e-4f;  // a traced ray closer than this to a torus has hit it
constexpr float kSlack = 1.5e-3f;  // what float32 may miss a solid by, as a share of how far it is
constexpr float kNone = std::numeric_limits<float>::infinity();

struct Bounds {
  float middle[3], half[3];
};

struct Waiting {
  float from;  // no hit in the box is nearer
  int32_t level;
  int64_t box;
};

float length(float x, float y) {
  return static_cast<float>(std::sqrt(static_cast<double>(x) * x + static_cast<double>(y) * y));
}

float entered(const float* o, const float* d, const float* half, float& leave) {
  float lows[3], highs[3];
  for (int k = 0; k < 3; ++k) {
    const float along = std::abs(d[k]) < 1e-9f ? 1e-9f : d[k];
    const float low = (-half[k] - o[k]) / along, high = (half[k] - o[k]) / along;
    lows[k] = std::min(low, high);
    highs[k] = std::max(low, high);
  }
  leave = std::min(std::min(highs[0], highs[1]), highs[2]);
  return std::max(std::max(lows[0], lows[1]), lows[2]);
}

float box(const float* o, const float* d, const float* half) {
  float leave;
  const float enter = entered(o, d, half, leave);
  return leave > enter && enter > 0.0f ? enter : kNone;
}

float sphere(const float* o, const float* d, float square) {
  const float b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2];
  const float root = b * b - (o[0] * o[0] + o[1] * o[1] + o[2] * o[2]) + square;
  const float t = -b - std::sqrt(std::max(root, 0.0f));
  return root >= 0.0f && t > 0.0f ? t : kNone;
}

// A ray is inside between the later of its two entries (tube, slab) and the earlier of its two exits.
float cylinder(const float* o, const float* d, float square, float half) {
  const float a = std::max(d[0] * d[0] + d[1] * d[1], 1e-12f);
  const float b = o[0] * d[0] + o[1] * d[1], c = o[0] * o[0] + o[1] * o[1] - square;
  const float root = b * b - a * c, spread = std::sqrt(std::max(root, 0.0f));
  const float along = std::abs(d[2]) < 1e-9f ? 1e-9f : d[2];
  const float low = (-half - o[2]) / along, high = (half - o[2]) / along;
  const float enter = std::max((-b - spread) / a, std::min(low, high));
  const float leave = std::min((-b + spread) / a, std::max(low, high));
  return root >= 0.0f && enter <= leave && enter > 0.0f ? enter : kNone;
}

float torus(const float* o, const float* d, float ring, float tube, float outer) {
  const float half[3] = {outer, outer, tube};
  float leave, t = entered(o, d, half, leave);
  if (!(leave > t && t > 0.0f)) return kNone;
  for (int step = 0; step < kTraceSteps; ++step) {
    const float off = length(o[0] + t * d[0], o[1] + t * d[1]) - ring;
    const float gap = length(off, o[2] + t * d[2]) - tube;
    if (gap < kSurface) return t;
    t = t + gap;
    if (!(t < leave)) return kNone;
  }
  return kNone;
}

float distance(const SolidsOnRays& in, int64_t solid, const float* origin, const float* direction) {
  const float* turn = in.turns + 9 * solid;
  const float* measures = in.measures + 3 * solid;
  float away[3], o[3], d[3];
  for (int k = 0; k < 3; ++k) away[k] = origin[k] - in.centres[3 * solid + k];
  for (int k = 0; k < 3; ++k) {
    o[k] = away[0] * turn[k] + away[1] * turn[3 + k] + away[2] * turn[6 + k];
    d[k] = direction[0] * turn[k] + direction[1] * turn[3 + k] + direction[2] * turn[6 + k];
  }
  switch (in.kinds[solid]) {
    case 0:
      return box(o, d, measures);
    case 1:
      return sphere(o, d, measures[0]);
    case 2:
      return cylinder(o, d, measures[0], measures[1]);
    default:
      return torus(o, d, measures[0], measures[1], measures[2]);
  }
}

Bounds around(const SolidsOnRays& in, int64_t solid) {
  const float* measures = in.measures + 3 * solid;
  const int32_t kind = in.kinds[solid];
  if (kind < 0 || kind > 3) {
    throw std::invalid_argument("first_solid: kinds must lie in 0 to 3, got " + std::to_string(kind));
  }
  float own[3] = {measures[0], measures[1], measures[2]};
  if (kind == 1 || kind == 2) own[0] = own[1] = own[2] = std::sqrt(measures[0]);
  if (kind == 2) own[2] = measures[1];
  if (kind == 3) own[0] = own[1] = measures[2], own[2] = measures[1];
  Bounds found;
  for (int k = 0; k < 3; ++k) {
    const float* row = in.turns + 9 * solid + 3 * k;
    found.middle[k] = in.centres[3 * solid + k];
    found.half[k] = std::abs(row[0]) * own[0] + std::abs(row[1]) * own[1] + std::abs(row[2]) * own[2];
  }
  return found;
}

Bounds around(const Bounds* boxes, int64_t count) {
  Bounds found;
  for (int k = 0; k < 3; ++k) {
    float low = kNone, high = -kNone;
    for (int64_t i = 0; i < count; ++i) {
      low = std::min(low, boxes[i].middle[k] - boxes[i].half[k]);
      high = std::max(high, boxes[i].middle[k] + boxes[i].half[k]);
    }
    found.middle[k] = 0.5f * (low + high);
    found.half[k] = 0.5f * (high - low);
  }
  return found;
}

using Levels = std::vector<std::vector<Bounds>>;

Levels tree(const SolidsOnRays& in) {
  Levels levels(1);
  for (int64_t solid = 0; solid < in.m; ++solid) levels[0].push_back(around(in, solid));
  while (levels.back().size() > 1) {
    const std::vector<Bounds>& below = levels.back();
    const int64_t count = static_cast<int64_t>(below.size());
    std::vector<Bounds> above;
    for (int64_t first = 0; first < count; first += kFan) {
      above.push_back(around(below.data() + first, std::min(kFan, count - first)));
    }
    levels.push_back(std::move(above));
  }
  return levels;
}

// How far a ray goes before it meets a box, larger by what rounding may miss; infinite if it does not.
float reached(const Bounds& bounds, const float* origin, const float* inverse) {
  float away[3], far = 1.0f;
  for (int k = 0; k < 3; ++k) {
    away[k] = bounds.middle[k] - origin[k];
    far += std::abs(away[k]) + bounds.half[k];
  }
  float enter = 0.0f, leave = std::numeric_limits<float>::max();
  for (int k = 0; k < 3; ++k) {
    const float half = bounds.half[k] + kSlack * far;
    const float low = (away[k] - half) * inverse[k], high = (away[k] + half) * inverse[k];
    enter = std::max(enter, std::min(low, high));
    leave = std::min(leave, std::max(low, high));
  }
  return enter <= leave ? enter : kNone;
}

}  // namespace

void first_solid_cpu(const SolidsOnRays& in, float* depth, int32_t* number, int) {
  const Levels levels = tree(in);
  const int32_t top = static_cast<int32_t>(levels.size()) - 1;
  for (int64_t ray = 0; ray < in.r; ++ray) {
    const float* origin = in.origins + (in.one_origin ? 0 : 3 * ray);
    const float* direction = in.directions + (in.one_direction ? 0 : 3 * ray);
    float inverse[3];
    for (int k = 0; k < 3; ++k) inverse[k] = 1.0f / (std::abs(direction[k]) < 1e-9f ? 1e-9f : direction[k]);
    float nearest = kNone;
    int32_t found = 0;
    Waiting waiting[kStack];
    int count = 0;
    if (in.m > 0) waiting[count++] = {0.0f, top, 0};
    while (count > 0) {
      const Waiting next = waiting[--count];
      if (next.from > nearest) continue;
      if (next.level == 0) {
        const float t = distance(in, next.box, origin, direction);
        const int32_t solid = static_cast<int32_t>(next.box);
        if (t < nearest || (t == nearest && t < kNone && solid < found)) nearest = t, found = solid;
        continue;
      }
      const std::vector<Bounds>& below = levels[next.level - 1];
      const int64_t end = std::min((next.box + 1) * kFan, static_cast<int64_t>(below.size()));
      const int first = count;
      for (int64_t child = next.box * kFan; child < end; ++child) {
        const float from = reached(below[child], origin, inverse);
        if (!(from <= nearest) || from == kNone) continue;
        int place = count++;
        for (; place > first && waiting[place - 1].from < from; --place) waiting[place] = waiting[place - 1];
        waiting[place] = {from, next.level - 1, child};
      }
    }
    depth[ray] = nearest;
    number[ray] = found;
  }
}

}  // namespace voronerf
