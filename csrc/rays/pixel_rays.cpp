// Blocks of rays over threads; each ray depends on itself alone. The pixels lie anywhere in the images, so a block asks
// for all of its own before it computes with the first.
#include "rays/pixel_rays.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>

#include "common/parallel.h"

namespace voronerf {

namespace {

constexpr int64_t kRays = 64;  // of a task
constexpr int kNewtonSteps = 12;
constexpr double kSettled = 1e-6;

// The point that the lens puts at (u, v): Newton's method and the models of voronerf/reference/camera_rays.py.
void undistort(const float* lens, bool fisheye, double u, double v, double& a, double& b) {
  const double k1 = lens[0], k2 = lens[1], p1 = lens[2], p2 = lens[3], k3 = lens[4], k4 = lens[5];
  const double k5 = fisheye ? 0 : lens[6], k6 = fisheye ? 0 : lens[7];
  const double s1 = fisheye ? lens[6] : 0, s2 = fisheye ? lens[7] : 0;
  a = u;
  b = v;
  for (int step = 0; step < kNewtonSteps; ++step) {
    const double r2 = a * a + b * b;
    double radial, slope;
    if (fisheye) {
      radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
      slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)));
    } else {
      const double below = 1 / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
      radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) * below;
      slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) * below;
    }
    const double du = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + s1 * r2 - u;
    const double dv = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + s2 * r2 - v;
    const double shared = a * b * slope + 2 * p1 * a + 2 * p2 * b;
    const double aa = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a + 2 * s1 * a, ab = shared + 2 * s1 * b;
    const double bb = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a + 2 * s2 * b, ba = shared + 2 * s2 * a;
    const double over = 1 / (aa * bb - ab * ba);
    const double left = (bb * du - ab * dv) * over, right = (aa * dv - ba * du) * over;
    a -= left;
    b -= right;
    // Newton's method doubles the digits: what is left is far below those of the result.
    if (std::abs(left) + std::abs(right) < kSettled) return;
  }
}

void direction_of(const PixelRaysInputs& in, int64_t camera, int64_t x, int64_t y, float* direction) {
  const float* lens = in.intrinsics + 4 * camera;
  const float* pose = in.poses + 16 * camera;
  const float px = static_cast<float>(x) + 0.5f, py = static_cast<float>(y) + 0.5f;
  float u, v, ahead = 1.0f;
  if (in.distortion == nullptr) {
    u = (px - lens[2]) / lens[0];
    v = (py - lens[3]) / lens[1];
  } else {
    double a, b;
    undistort(in.distortion + 8 * camera, in.fisheye, (static_cast<double>(px) - lens[2]) / lens[0],
              (static_cast<double>(py) - lens[3]) / lens[1], a, b);
    if (in.fisheye) {
      const double angle = std::sqrt(a * a + b * b), share = angle == 0 ? 1 : std::sin(angle) / angle;
      a *= share;
      b *= share;
      ahead = static_cast<float>(std::cos(angle));
    }
    u = static_cast<float>(a);
    v = static_cast<float>(b);
  }
  float square = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    direction[axis] = pose[4 * axis] * u - pose[4 * axis + 1] * v - pose[4 * axis + 2] * ahead;
    square += direction[axis] * direction[axis];
  }
  const float length = std::max(std::sqrt(square), 1e-12f);
  for (int axis = 0; axis < 3; ++axis) direction[axis] /= length;
}

// The slab method; a ray that misses has no extent.
void meet_box(const PixelRaysInputs& in, const float* origin, const float* direction, float& near, float& far) {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  float enter = -kInfinity, leave = kInfinity;
  for (int axis = 0; axis < 3; ++axis) {
    const float bottom = in.box[axis], top = in.box[3 + axis];
    if (direction[axis] == 0.0f) {  // inside at all distances, or at none
      if (origin[axis] < bottom || origin[axis] > top) enter = kInfinity, leave = -kInfinity;
      continue;
    }
    const float one = (bottom - origin[axis]) / direction[axis], other = (top - origin[axis]) / direction[axis];
    enter = std::max(enter, std::min(one, other));
    leave = std::min(leave, std::max(one, other));
  }
  near = std::min(std::max(enter, in.near), in.far);
  far = std::max(near, std::min(std::max(leave, in.near), in.far));
}

void colour_of(const PixelRaysInputs& in, const uint8_t* pixel, int64_t ray, float* colour) {
  for (int channel = 0; channel < 3; ++channel) colour[channel] = static_cast<float>(pixel[channel]) / 255.0f;
  if (in.channels < 4 || in.background == nullptr) return;
  const float* background = in.background + (in.background_per_ray ? 3 * ray : 0);
  const float alpha = static_cast<float>(pixel[3]) / 255.0f;
  for (int channel = 0; channel < 3; ++channel) {
    colour[channel] = colour[channel] * alpha + background[channel] * (1.0f - alpha);
  }
}

}  // namespace

bool pixel_rays_cpu(const PixelRaysInputs& in, const PixelRaysOutputs& out, int threads) {
  const int64_t each = in.h * in.w, blocks = (in.b + kRays - 1) / kRays;
  std::atomic<bool> fine{true};
  parallel_for(blocks, 1, threads, [&](int64_t block) {
    const int64_t begin = block * kRays, end = std::min(in.b, begin + kRays);
    for (int64_t i = begin; i < end; ++i) {
      if (in.pixels[i] < 0 || in.pixels[i] >= in.c * each) {
        fine.store(false, std::memory_order_relaxed);
        return;
      }
      __builtin_prefetch(in.images + in.channels * in.pixels[i]);
    }
    for (int64_t i = begin; i < end; ++i) {
      const int64_t camera = in.pixels[i] / each, pixel = in.pixels[i] % each;
      float *origin = out.origins + 3 * i, *direction = out.directions + 3 * i;
      for (int axis = 0; axis < 3; ++axis) origin[axis] = in.poses[16 * camera + 4 * axis + 3];
      direction_of(in, camera, pixel % in.w, pixel / in.w, direction);
      out.near[i] = in.near;
      out.far[i] = in.far;
      if (in.box != nullptr) meet_box(in, origin, direction, out.near[i], out.far[i]);
      colour_of(in, in.images + in.channels * in.pixels[i], i, out.colour + 3 * i);
    }
  });
  return fine.load(std::memory_order_relaxed);
}

}  // namespace voronerf
