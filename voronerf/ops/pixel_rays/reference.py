"""Rays through pixels of images, with their colours. c images of h x w pixels, b rays."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range
from voronerf.ops.formulas import meet_box


class PixelRays(NamedTuple):
    """The result of `pixel_rays`.

    Attributes:
        origins: [b, 3], the origins of the rays.
        directions: [b, 3], unit vectors.
        near: [b], the distance at which each ray enters the box.
        far: [b], the distance at which each ray leaves the box; `near` if it misses the box.
        colour: [b, 3], the colours of the pixels, 0 to 1.

    Examples:
        >>> import torch
        >>> from voronerf.ops import pixel_rays
        >>> image = torch.full((1, 1, 1, 3), 51, dtype=torch.uint8)
        >>> lens, index = torch.tensor([[1.0, 1.0, 0.5, 0.5]]), torch.zeros(2, dtype=torch.int64)
        >>> pixel_rays(torch.eye(4)[None], lens, image, index, near=1.0, far=2.0).colour
        tensor([[0.2000, 0.2000, 0.2000],
                [0.2000, 0.2000, 0.2000]])
    """

    origins: Annotated[Tensor, "same [b, 3]"]
    directions: Annotated[Tensor, "same [b, 3]"]
    near: Annotated[Tensor, "same [b]"]
    far: Annotated[Tensor, "same [b]"]
    colour: Annotated[Tensor, "same [b, 3]"]


@torch.no_grad()
def pixel_rays(*arguments: Any) -> PixelRays:
    """Makes rays, intersects them with the box and reads colours; see ``voronerf.ops.pixel_rays``."""
    poses, intrinsics, images, index, near, far, box, lens, tables, background = arguments
    c, h, w, channels = images.shape
    check_range("pixel_rays", "index", index, c * h * w)
    pixel = index % (h * w)
    x, y = ((place + 0.5).to(poses.dtype) for place in (pixel % w, pixel // w))
    camera = index // (h * w)
    fx, fy, cx, cy = intrinsics[camera].unbind(-1)
    u, v, ahead = (x - cx) / fx, (y - cy) / fy, torch.ones_like(x)
    if lens is not None and tables is not None and len(tables):
        table = lens[camera].long()
        bent = (table >= 0) & (table < len(tables))
        right, down = tables.reshape(-1, 2)[torch.where(bent, table, 0) * (h * w) + pixel].unbind(-1)
        square = right * right + down * down
        u, v, ahead = (torch.where(bent, a, b) for a, b in ((2 * right, u), (2 * down, v), (1 - square, ahead)))
    local = torch.stack((u, -v, -ahead), dim=-1)
    directions = torch.nn.functional.normalize((poses[camera, :3, :3] * local[:, None, :]).sum(-1), dim=-1)
    origins = poses[camera, :3, 3]
    if box is None:
        enter, leave = torch.full_like(x, near), torch.full_like(x, far)
    else:
        enter, leave = meet_box(origins, directions, box, near, far)
    values = images.reshape(-1, channels)[index].to(poses.dtype) / 255
    colour = values[:, :3]
    if channels == 4 and background is not None:
        alpha = values[:, 3:]
        colour = colour * alpha + background * (1 - alpha)
    return PixelRays(origins, directions, enter, leave, colour.contiguous())
