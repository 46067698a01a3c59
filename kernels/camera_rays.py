"""Rays through pixels as a Warp kernel. c cameras, b pixels.

A thread takes a pixel. The distortion of the lens is undone in float64 by the reference's fixed number of Newton steps.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import warp as wp
from torch import Tensor

from voronerf.custom_op import custom_op
from voronerf.kernels._launch import filled, launch
from voronerf.ops.camera_rays.reference import FISHEYE, FOV, NEWTON_STEPS, PERSPECTIVE, TINY

wp.set_module_options({"enable_backward": False})

_STEPS = wp.constant(NEWTON_STEPS)
_PERSPECTIVE, _FISHEYE, _FOV = wp.constant(PERSPECTIVE), wp.constant(FISHEYE), wp.constant(FOV)
_TINY = wp.constant(TINY)


@wp.struct
class Pixels:
    """Places in images, and the cameras that took them."""

    poses: wp.array3d(dtype=wp.float32)
    intrinsics: wp.array2d(dtype=wp.float32)
    x: wp.array(dtype=wp.float32)
    y: wp.array(dtype=wp.float32)
    camera: wp.array(dtype=wp.int32)
    several: wp.bool
    distortion: wp.array2d(dtype=wp.float32)
    distorted: wp.bool
    models: wp.array(dtype=wp.int32)


@wp.struct
class Rays:
    """Results."""

    origins: wp.array2d(dtype=wp.float32)
    directions: wp.array2d(dtype=wp.float32)


@wp.kernel
def _camera_rays_kernel(
    given: Pixels,
    rays: Rays,
) -> None:
    i = wp.tid()
    c = wp.int32(0)
    if given.several:
        c = wp.clamp(given.camera[i], 0, given.poses.shape[0] - 1)
    u = (wp.float64(given.x[i]) - wp.float64(given.intrinsics[c, 2])) / wp.float64(given.intrinsics[c, 0])
    v = (wp.float64(given.y[i]) - wp.float64(given.intrinsics[c, 3])) / wp.float64(given.intrinsics[c, 1])
    ahead = wp.float64(1.0)
    if given.distorted:
        k1 = wp.float64(given.distortion[c, 0])
        k2 = wp.float64(given.distortion[c, 1])
        p1 = wp.float64(given.distortion[c, 2])
        p2 = wp.float64(given.distortion[c, 3])
        k3 = wp.float64(given.distortion[c, 4])
        k4 = wp.float64(given.distortion[c, 5])
        k5 = wp.float64(given.distortion[c, 6])
        k6 = wp.float64(given.distortion[c, 7])
        nothing = wp.float64(0.0)
        s1 = nothing
        s2 = nothing
        fourth = nothing
        one = wp.float64(1.0)
        two = wp.float64(2.0)
        three = wp.float64(3.0)
        four = wp.float64(4.0)
        six = wp.float64(6.0)
        model = wp.int32(_PERSPECTIVE)
        if given.models.shape[0] > 0:
            model = given.models[c]
        if model == _FOV:
            radius = wp.max(wp.sqrt(u * u + v * v), wp.float64(_TINY))
            if k1 != nothing:
                share = wp.tan(radius * k1) / (radius * two * wp.tan(k1 / two))
                u = u * share
                v = v * share
            k1 = nothing
            k2 = nothing
            p1 = nothing
            p2 = nothing
            k3 = nothing
            k4 = nothing
            k5 = nothing
            k6 = nothing
        if model == _FISHEYE:
            fourth = k4
            s1 = k5
            s2 = k6
            k4 = nothing
            k5 = nothing
            k6 = nothing
        a = u
        b = v
        for _ in range(_STEPS):
            r2 = a * a + b * b
            below = one + r2 * (k4 + r2 * (k5 + r2 * k6))
            radial = (one + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * fourth)))) / below
            rise = k1 + r2 * (two * k2 + r2 * (three * k3 + r2 * four * fourth))
            fall = radial * (k4 + r2 * (two * k5 + r2 * three * k6))
            slope = two * (rise - fall) / below
            du = a * radial + two * p1 * a * b + p2 * (r2 + two * a * a) + s1 * r2 - u
            dv = b * radial + p1 * (r2 + two * b * b) + two * p2 * a * b + s2 * r2 - v
            shared = a * b * slope + two * p1 * a + two * p2 * b
            aa = radial + a * a * slope + two * p1 * b + six * p2 * a + two * s1 * a
            ab = shared + two * s1 * b
            ba = shared + two * s2 * a
            bb = radial + b * b * slope + six * p1 * b + two * p2 * a + two * s2 * b
            determinant = aa * bb - ab * ba
            a = a - (bb * du - ab * dv) / determinant
            b = b - (aa * dv - ba * du) / determinant
        u = a
        v = b
        if model == _FISHEYE:
            angle = wp.sqrt(u * u + v * v)
            if angle > wp.float64(0.0):
                u = u * wp.sin(angle) / angle
                v = v * wp.sin(angle) / angle
            ahead = wp.cos(angle)
    along = wp.vec3(wp.float32(u), -wp.float32(v), -wp.float32(ahead))
    direction = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        direction[axis] = (
            given.poses[c, axis, 0] * along[0] + given.poses[c, axis, 1] * along[1] + given.poses[c, axis, 2] * along[2]
        )
        rays.origins[i, axis] = given.poses[c, axis, 3]
    direction = direction / wp.max(wp.length(direction), 1.0e-12)
    for axis in range(3):
        rays.directions[i, axis] = direction[axis]


@custom_op("camera_rays_warp")
def camera_rays(
    poses: Tensor,
    intrinsics: Tensor,
    x: Tensor,
    y: Tensor,
    camera: Tensor | None,
    distortion: Tensor | None,
    models: Tensor | None,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Origins and unit directions; see ``voronerf.ops.camera_rays``."""
    origins, directions = poses.new_empty(x.shape[0], 3), poses.new_empty(x.shape[0], 3)
    yield origins, directions
    none = x.new_empty(0, dtype=torch.int32)
    cameras = {"poses": poses, "intrinsics": intrinsics, "models": none if models is None else models}
    lens = intrinsics.new_empty(0, 8) if distortion is None else distortion
    given = filled(Pixels(), x=x, y=y, camera=none if camera is None else camera, several=camera is not None, **cameras)
    filled(given, distortion=lens, distorted=distortion is not None)
    launch(_camera_rays_kernel, x.shape[0], [given, filled(Rays(), origins=origins, directions=directions)], poses)
