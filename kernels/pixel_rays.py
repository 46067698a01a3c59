"""Rays through pixels as Warp kernels: those of ``camera_rays``, then the box that they meet and the colours of pixels.

c images of h x w pixels, b rays, a thread each.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.kernels.camera_rays import camera_rays
from voronerf.ops.pixel_rays.reference import PixelRays, Pixels

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


def pixel_rays(pixels: Pixels) -> PixelRays:
    """Rays, where they meet the box, and colours; see ``voronerf.ops.pixel_rays``."""
    poses, intrinsics, images, index, box, distortion, models, background, near, far = pixels
    _, h, w, _ = images.shape
    pixel = index % (h * w)
    x, y = ((place + 0.5).to(poses.dtype) for place in (pixel % w, pixel // w))
    camera = (index // (h * w)).to(torch.int32)
    origins, directions = camera_rays(poses, intrinsics, x, y, camera=camera, distortion=distortion, models=models)
    behind = None if background is None else background.expand(index.shape[0], 3)
    first, last, colour = _cut_and_colour(origins, directions, images, index, box, behind, near, far)
    return PixelRays(origins, directions, first, last, colour)


@torch.library.custom_op("voronerf::pixel_rays_warp", mutates_args=())
def _cut_and_colour(
    origins: Tensor,
    directions: Tensor,
    images: Tensor,
    index: Tensor,
    box: Tensor | None,
    background: Tensor | None,
    near: float,
    far: float,
) -> tuple[Tensor, Tensor, Tensor]:
    flat = images.reshape(-1, images.shape[-1])
    if not index.is_cuda and index.shape[0] > 0:
        low, high = (int(bound) for bound in index.aminmax())
        if low < 0 or high >= flat.shape[0]:
            raise ValueError(f"pixel_rays: index must lie in 0 to {flat.shape[0] - 1}, got values from {low} to {high}")
    first, last, colour = results = _allocate(origins)
    corners = array(origins.new_empty(0, 3) if box is None else box, origins)
    rays = [array(tensor, origins) for tensor in (origins, directions)]
    cut = [array(tensor, origins) for tensor in (first, last)]
    launch(_meet_box_kernel, index.shape[0], [*rays, corners, near, far, *cut], origins)
    behind = origins.new_empty(0, 3) if background is None else background
    launch(_colour_kernel, index.shape[0], [array(t, origins) for t in (flat, index, behind, colour)], origins)
    return results


@_cut_and_colour.register_fake
def _(
    origins: Tensor,
    directions: Tensor,
    images: Tensor,
    index: Tensor,
    box: Tensor | None,
    background: Tensor | None,
    near: float,
    far: float,
) -> tuple[Tensor, Tensor, Tensor]:
    return _allocate(origins)


def _allocate(origins: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    b = origins.shape[0]
    return origins.new_empty(b), origins.new_empty(b), origins.new_empty(b, 3)
