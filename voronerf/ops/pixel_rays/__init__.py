"""Rays through pixels of images, and what a loss needs of them. c images of h x w pixels, b rays."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.checks import INDEX, LIKE_FIRST, Checked, check_number, detached
from voronerf.ops.pixel_rays.reference import PixelRays, Pixels

_OP = backends.declare("pixel_rays", native=Implementation(EVERYWHERE, (torch.float32,)))


def pixel_rays(
    poses: Tensor,
    intrinsics: Tensor,
    images: Tensor,
    index: Tensor,
    *,
    near: float,
    far: float,
    box: Tensor | None = None,
    lens: Tensor | None = None,
    tables: Tensor | None = None,
    background: Tensor | None = None,
    backend: str = "auto",
) -> PixelRays:
    """The rays of a training step: through the centres of pixels, cut to a box, with the colours of the pixels.

    The box is met by the slab method (Kay and Kajiya 1986). Not differentiable.

    Args:
        poses: float32 [c, 4, 4], camera to world, OpenGL axes.
        intrinsics: float32 [c, 4], (fx, fy, cx, cy) in pixels.
        images: uint8 [c, h, w, 3], or [c, h, w, 4] with an alpha channel that the colours are not multiplied by.
        index: int64 [b], the pixels: image * h * w + row * w + column. Others are an error on the CPU, and undefined on
            CUDA, where they are not checked.
        near: nearest distance of interest, >= 0.
        far: farthest.
        box: float32 [2, 3], lowest and highest corner, or None for all of space.
        lens: int32 [c], the table of each camera; a number that no table has, such as -1, is a camera without
            distortion. It comes with tables.
        tables: float32 [l, h, w, 2], for each lens the directions (x, y, z) of its pixels in the camera's axes as
            stereographic projections (x, -y) / (1 - z), see `voronerf.nerf.lenses.LensTables`; None for no distortion.
        background: float32 [3] or [b, 3], the colour behind images with an alpha channel; None leaves their
            colours as they are.
        backend: "auto", "reference" or "native".

    Returns:
        PixelRays(origins, directions, near, far, colour). A ray that misses the box has far == near.

    Raises:
        ValueError: on the CPU pixels out of range.

    Examples:
        >>> import torch
        >>> from voronerf.ops import pixel_rays
        >>> poses = torch.eye(4)[None]  # at the origin, looking along -z
        >>> intrinsics = torch.tensor([[1.0, 1.0, 0.5, 0.5]])
        >>> image = torch.tensor([[[[255, 0, 0, 51]]]], dtype=torch.uint8)  # a fifth of red
        >>> box, white = torch.tensor([[-1.0, -1, -3], [1.0, 1, -2]]), torch.ones(3)
        >>> index = torch.zeros(1, dtype=torch.int64)
        >>> rays = pixel_rays(poses, intrinsics, image, index, near=0.0, far=9.0, box=box, background=white)
        >>> rays.near, rays.far, rays.colour
        (tensor([2.]), tensor([3.]), tensor([[1.0000, 0.8000, 0.8000]]))
    """
    given = Checked(_OP)
    given.tensor("poses", poses, (torch.float32,), "c", 4, 4)
    given.tensor("intrinsics", intrinsics, LIKE_FIRST, "c", 4)
    given.tensor("images", images, (torch.uint8,), "c", "h", "w", "channels")
    given.tensor("index", index, (torch.int64,), "b")
    given.optional("box", box, LIKE_FIRST, 2, 3)
    given.optional("lens", lens, INDEX, "c")
    given.optional("tables", tables, LIKE_FIRST, "l", "h", "w", 2)
    if (lens is None) != (tables is None):
        raise ValueError(f"{_OP}: lens and tables must be given together, got one")
    given.each_or_all("background", background, LIKE_FIRST, "b", 3)
    if given.sizes["channels"] not in (3, 4):
        raise ValueError(f"{_OP}: images must have 3 or 4 channels, got {given.sizes['channels']}")
    check_number(_OP, "near", near)
    check_number(_OP, "far", far)
    if not 0 <= near < far:
        raise ValueError(f"{_OP}: near and far must satisfy 0 <= near < far, got {near} and {far}")
    if torch.finfo(torch.float32).max < far < float("inf"):
        raise ValueError(f"{_OP}: far must be at most 3.4e+38 or infinite, got {far}")
    run = backends.resolve(_OP, backend=backend, device=poses.device, dtype=poses.dtype)
    box, tables, background = (detached(tensor) for tensor in (box, tables, background))
    views = detached(poses), detached(intrinsics), images
    return PixelRays(*run(Pixels(*views, index, box, lens, tables, background, float(near), float(far))))
