"""Rays through pixels as Warp kernels: those of ``camera_rays``, then the box that they meet and the colours of pixels.

c images of h x w pixels, b rays, a thread each.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import warp as wp
from torch import Tensor

from voronerf.checks import check_range
from voronerf.custom_op import custom_op
from voronerf.kernels._launch import array, launch
from voronerf.kernels.camera_rays import camera_rays
from voronerf.ops.pixel_rays.reference import Pixels

wp.set_module_options({"enable_backward": False})

_INFINITY = wp.constant(float("inf"))


@wp.kernel
def _meet_box_kernel(
    origins: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.float32),
    box: wp.array2d(dtype=wp.float32),
    near: wp.float32,
    far: wp.float32,
    first: wp.array(dtype=wp.float32),
    last: wp.array(dtype=wp.float32),
) -> None:
    i = wp.tid()
    enter = -_INFINITY
    leave = _INFINITY
    if box.shape[0] > 0:
        for axis in range(3):
            origin = origins[i, axis]
            direction = directions[i, axis]
            if direction == 0.0:  # inside at all distances, or at none
                if origin < box[0, axis] or origin > box[1, axis]:
                    enter = _INFINITY
                    leave = -_INFINITY
            else:
                one = (box[0, axis] - origin) / direction
                other = (box[1, axis] - origin) / direction
                enter = wp.max(enter, wp.min(one, other))
                leave = wp.min(leave, wp.max(one, other))
    entered = wp.clamp(enter, near, far)
    first[i] = entered
    last[i] = wp.max(entered, wp.clamp(leave, near, far))


@wp.kernel
def _colour_kernel(
    images: wp.array2d(dtype=wp.uint8),
    index: wp.array(dtype=wp.int64),
    background: wp.array2d(dtype=wp.float32),
    colour: wp.array2d(dtype=wp.float32),
) -> None:
    i = wp.tid()
    pixel = index[i]
    alpha = wp.float32(1.0)
    over = images.shape[1] == 4 and background.shape[0] > 0
    if over:
        alpha = wp.float32(images[pixel, 3]) / 255.0
    for channel in range(3):
        value = wp.float32(images[pixel, channel]) / 255.0
        if over:
            value = value * alpha + background[i, channel] * (1.0 - alpha)
        colour[i, channel] = value


@custom_op("pixel_rays_warp")
def pixel_rays(pixels: Pixels) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """Rays, where they meet the box, and colours; see ``voronerf.ops.pixel_rays``."""
    poses, index, b = pixels.poses, pixels.numbers, pixels.numbers.shape[0]
    origins, directions, colour = (poses.new_empty(b, 3) for _ in range(3))
    first, last = poses.new_empty(b), poses.new_empty(b)
    yield origins, directions, first, last, colour
    c, h, w, channels = pixels.images.shape
    check_range("pixel_rays", "index", index, c * h * w)
    pixel = index % (h * w)
    x, y = ((place + 0.5).to(poses.dtype) for place in (pixel % w, pixel // w))
    camera = (index // (h * w)).to(torch.int32)
    rays = camera_rays(poses, pixels.intrinsics, x, y, camera, pixels.distortion, pixels.models)
    origins.copy_(rays[0])
    directions.copy_(rays[1])
    box = origins.new_empty(0, 3) if pixels.box is None else pixels.box
    behind = origins.new_empty(0, 3) if pixels.background is None else pixels.background.expand(b, 3)
    given = [array(tensor, origins) for tensor in (origins, directions, box)]
    launch(_meet_box_kernel, b, [*given, pixels.near, pixels.far, array(first, poses), array(last, poses)], poses)
    images = pixels.images.reshape(-1, channels)
    launch(_colour_kernel, b, [array(tensor, origins) for tensor in (images, index, behind, colour)], poses)
