// Arithmetic of pixel_rays, one ray at a time, for the CPU and for CUDA.
#pragma once

#include <cmath>
#include <cstdint>

#include "common/hd.h"
#include "rays/pixel_rays.h"

namespace voronerf {

constexpr int kNewtonSteps = 12;
constexpr double kSettled = 1e-6, kTiny = 1e-12;
constexpr int32_t kPerspective = 0, kFisheye = 1, kFov = 2;

// The point that the lens puts at (u, v): Newton's method and the models of voronerf/ops/pixel_rays/lens.py.
VN_HD void undistort(const float* lens, int32_t model, double u, double v, double& a, double& b) {
  if (model == kFov) {
    const double omega = lens[0], radius = fmax(sqrt(u * u + v * v), kTiny);
    const double share = omega == 0 ? 1 : tan(radius * omega) / (radius * 2 * tan(omega / 2));
    a = u * share;
    b = v * share;
    return;
  }
  const bool fisheye = model == kFisheye;
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
    if (fabs(left) + fabs(right) < kSettled) return;
  }
}

VN_HD void pixel_direction(const PixelRaysInputs& in, int64_t camera, int64_t x, int64_t y, float* direction) {
  const float* lens = in.intrinsics + 4 * camera;
  const float* pose = in.poses + 16 * camera;
  const float px = static_cast<float>(x) + 0.5f, py = static_cast<float>(y) + 0.5f;
  float u, v, ahead = 1.0f;
  if (in.distortion == nullptr) {
    u = (px - lens[2]) / lens[0];
    v = (py - lens[3]) / lens[1];
  } else {
    double a, b;
    const int32_t model = in.models == nullptr ? kPerspective : in.models[camera];
    undistort(in.distortion + 8 * camera, model, (static_cast<double>(px) - lens[2]) / lens[0],
              (static_cast<double>(py) - lens[3]) / lens[1], a, b);
    if (model == kFisheye) {
      const double angle = sqrt(a * a + b * b), share = angle == 0 ? 1 : sin(angle) / angle;
      a *= share;
      b *= share;
      ahead = static_cast<float>(cos(angle));
    }
    u = static_cast<float>(a);
    v = static_cast<float>(b);
  }
  float square = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    direction[axis] = pose[4 * axis] * u - pose[4 * axis + 1] * v - pose[4 * axis + 2] * ahead;
    square += direction[axis] * direction[axis];
  }
  float length = sqrtf(square);
  if (length < 1e-12f) length = 1e-12f;
  for (int axis = 0; axis < 3; ++axis) direction[axis] /= length;
}

// The first where they do not compare, as with std::min and std::max, which CUDA has not.
VN_HD float smaller(float a, float b) {
  return b < a ? b : a;
}
VN_HD float larger(float a, float b) {
  return a < b ? b : a;
}

// The slab method; a ray that misses has no extent.
VN_HD void meet_box(const PixelRaysInputs& in, const float* origin, const float* direction, float& near, float& far) {
  float enter = -INFINITY, leave = INFINITY;
  for (int axis = 0; axis < 3; ++axis) {
    const float bottom = in.box[axis], top = in.box[3 + axis];
    if (direction[axis] == 0.0f) {  // inside at all distances, or at none
      if (origin[axis] < bottom || origin[axis] > top) enter = INFINITY, leave = -INFINITY;
      continue;
    }
    const float one = (bottom - origin[axis]) / direction[axis], other = (top - origin[axis]) / direction[axis];
    enter = larger(enter, smaller(one, other));
    leave = smaller(leave, larger(one, other));
  }
  near = smaller(larger(enter, in.near), in.far);
  far = larger(near, smaller(larger(leave, in.near), in.far));
}

VN_HD void pixel_colour(const PixelRaysInputs& in, const uint8_t* pixel, int64_t ray, float* colour) {
  for (int channel = 0; channel < 3; ++channel) colour[channel] = static_cast<float>(pixel[channel]) / 255.0f;
  if (in.channels < 4 || in.background == nullptr) return;
  const float* background = in.background + (in.background_per_ray ? 3 * ray : 0);
  const float alpha = static_cast<float>(pixel[3]) / 255.0f;
  for (int channel = 0; channel < 3; ++channel) {
    colour[channel] = colour[channel] * alpha + background[channel] * (1.0f - alpha);
  }
}

// Ray number `ray`, of a pixel that there is.
VN_HD void pixel_ray(const PixelRaysInputs& in, const PixelRaysOutputs& out, int64_t ray) {
  const int64_t each = in.h * in.w, number = in.pixels[ray];
  const int64_t camera = number / each, pixel = number - camera * each, y = pixel / in.w;
  float *origin = out.origins + 3 * ray, *direction = out.directions + 3 * ray;
  for (int axis = 0; axis < 3; ++axis) origin[axis] = in.poses[16 * camera + 4 * axis + 3];
  pixel_direction(in, camera, pixel - y * in.w, y, direction);
  out.near[ray] = in.near;
  out.far[ray] = in.far;
  if (in.box != nullptr) meet_box(in, origin, direction, out.near[ray], out.far[ray]);
  pixel_colour(in, in.images + in.channels * number, ray, out.colour + 3 * ray);
}

}  // namespace voronerf
