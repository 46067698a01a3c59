"""Rays through pixels of images, with their colours. c images of h x w pixels, b rays."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.pixel_rays.reference import PixelRays


def _prepare(arguments: Any) -> Any:
    near, far, channels = arguments.near, arguments.far, arguments.images.shape[3]
    if (arguments.lens is None) != (arguments.tables is None):
        raise ValueError("pixel_rays: lens and tables must be given together, got one")
    if channels not in (3, 4):
        raise ValueError(f"pixel_rays: images must have 3 or 4 channels, got {channels}")
    if not 0 <= near < far:
        raise ValueError(f"pixel_rays: near and far must satisfy 0 <= near < far, got {near} and {far}")
    if torch.finfo(torch.float32).max < far < float("inf"):
        raise ValueError(f"pixel_rays: far must be at most 3.4e+38 or infinite, got {far}")
    return arguments


@declare(native=Implementation(EVERYWHERE, (torch.float32,)), warp=PLAIN, prepare=_prepare)
def pixel_rays(
    poses: Annotated[Tensor, "float32 [c, 4, 4]"],
    intrinsics: Annotated[Tensor, "same [c, 4]"],
    images: Annotated[Tensor, "uint8 [c, h, w, channels]"],
    index: Annotated[Tensor, "int64 [b]"],
    *,
    near: float,
    far: float,
    box: Annotated[Tensor | None, "same [2, 3]"] = None,
    lens: Annotated[Tensor | None, "int32 [c]"] = None,
    tables: Annotated[Tensor | None, "same [l, h, w, 2]"] = None,
    background: Annotated[Tensor | None, "same [3] or [b, 3]"] = None,
    backend: str = "auto",
) -> PixelRays:
    """Makes the rays of a training step: through the centres of pixels, clipped to a box, with the pixels' colours.

    Rays are intersected with the box by the slab method (Kay and Kajiya 1986). Not differentiable.

    Args:
        poses: the camera-to-world matrices, OpenGL axes.
        intrinsics: (fx, fy, cx, cy) of each camera in pixels.
        images: the images, with or without an alpha channel; colours are not premultiplied.
        index: the pixels: image * h * w + row * w + column. The CPU refuses pixels out of range; CUDA clamps them,
            without a check.
        near: the nearest distance of interest, >= 0.
        far: the farthest distance of interest.
        box: the lowest and the highest corner; None for all of space.
        lens: the index of each camera's table, or an index out of range, such as -1, for a camera without distortion.
            Requires ``tables``.
        tables: the directions (x, y, z) of each lens's pixels in camera axes, as stereographic projections
            ``(x, -y) / (1 - z)``; see `voronerf.nerf.lenses.LensTables`. None for no distortion.
        background: the colour behind images with an alpha channel; None to ignore alpha.

    Returns:
        PixelRays(origins, directions, near, far, colour); far == near for a ray that misses the box.

    Raises:
        ValueError: a pixel is out of range (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import pixel_rays
        >>> poses = torch.eye(4)[None]  # at the origin, looking along -z
        >>> intrinsics = torch.tensor([[1.0, 1.0, 0.5, 0.5]])
        >>> image = torch.tensor([[[[255, 0, 0, 51]]]], dtype=torch.uint8)  # red, alpha 0.2
        >>> box, white = torch.tensor([[-1.0, -1, -3], [1.0, 1, -2]]), torch.ones(3)
        >>> index = torch.zeros(1, dtype=torch.int64)
        >>> rays = pixel_rays(poses, intrinsics, image, index, near=0.0, far=9.0, box=box, background=white)
        >>> rays.near, rays.far, rays.colour
        (tensor([2.]), tensor([3.]), tensor([[1.0000, 0.8000, 0.8000]]))
    """
