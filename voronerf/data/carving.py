"""A tight box around an object, from its silhouettes (space carving; Kutulakos and Seitz 2000, without colours).

c images of h x w pixels, n voxels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from voronerf.rendering.cameras import Cameras, focus_point

COARSE, FINE = 24, 48
MASK_PIXELS = 100
SEEN_BY = 0.25  # an object is in the picture in at least this share of the views
MISSED_BY = 0.02  # share of the views that see a voxel whose masks may be wrong about it
OUTSIDE = 1e-3  # share of the masks' pixels whose rays may miss the box


def carve_box(cameras: Cameras, alpha: Tensor, near: float, far: float) -> Tensor | None:
    """The bounding box of the space that all masks leave.

    A voxel stays unless some views see it entirely outside of their mask. It is compared with the mask widened by the
    voxel's own size in pixels, so that the box never cuts what a mask shows; it is larger than the object by about a voxel
    (a fortieth of the object's size) and by what no silhouette can carve.

    Args:
        cameras: c cameras that look at the object from around it.
        alpha: uint8 [c, h, w]; a pixel with alpha > 0 shows the object.
        near: distance before which there is nothing.
        far: distance behind which there is nothing; the search covers a cube of half side (far - near) / 2.

    Returns:
        float32 [2, 3], or None where there is no such box: nothing or everything is opaque, the cameras have no common
        focus, or the box would miss more than a thousandth of what the masks show.
    """
    visible = alpha > 0
    centre = focus_point(cameras)
    if centre is None or not bool(visible.any()) or bool(visible.all()):
        return None
    shrink = max(1, min(alpha.shape[1:]) // MASK_PIXELS)
    masks = max_pool2d(visible[:, None].float(), shrink, ceil_mode=True)[:, 0]
    half = (far - near) / 2
    box = torch.stack((centre - half, centre + half))
    for resolution in (COARSE, FINE):
        carved = _carve(cameras, masks, shrink, box, resolution)
        if carved is None:
            return None
        box = carved
    return box if _share_outside(cameras, visible, box) <= OUTSIDE else None


def _carve(cameras: Cameras, masks: Tensor, shrink: int, box: Tensor, resolution: int) -> Tensor | None:
    """One pass over a grid of resolution^3 voxels in `box`; the box of the voxels that stay."""
    size = (box[1] - box[0]) / resolution
    steps = torch.arange(resolution, dtype=box.dtype) + 0.5
    grid = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1).reshape(-1, 3)
    points = box[0] + grid * size
    radius = 0.5 * float(size.norm())
    seen, missed = torch.zeros(len(points)), torch.zeros(len(points))
    for index in range(len(cameras)):
        pixels, depth = cameras.project(points, index)
        # voxels whose ball reaches behind the camera say nothing
        ahead = depth > 2 * radius
        if not bool(ahead.any()):
            continue
        reach = radius * float(cameras.intrinsics[index, :2].max()) / (float(depth[ahead].min()) - radius)
        grow = math.ceil(reach / shrink) + 1
        mask = _widen(masks[index], grow)
        column, row = (pixels / shrink).floor().unbind(-1)
        inside = ahead & (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
        at = torch.where(inside, row * mask.shape[1] + column, 0).long()
        seen += inside
        missed += inside & ~mask.reshape(-1)[at]
    stays = (seen >= SEEN_BY * len(cameras)) & (missed <= MISSED_BY * seen)
    if not bool(stays.any()):
        return None
    kept = points[stays]
    return torch.stack((kept.amin(0) - size / 2, kept.amax(0) + size / 2))


def _widen(mask: Tensor, grow: int) -> Tensor:
    """Dilates a mask by a square of `grow` pixels on each side."""
    rows = max_pool2d(mask[None, None], (2 * grow + 1, 1), stride=1, padding=(grow, 0))
    return max_pool2d(rows, (1, 2 * grow + 1), stride=1, padding=(0, grow))[0, 0] > 0


def _share_outside(cameras: Cameras, visible: Tensor, box: Tensor) -> float:
    """Share of the masks' pixels whose rays miss the box."""
    image, row, column = visible.nonzero().unbind(-1)
    step = max(1, len(image) // 100_000)
    rays = cameras.rays(image[::step], column[::step], row[::step])
    low, high = (box[0] - rays.origins) / rays.directions, (box[1] - rays.origins) / rays.directions
    hit = torch.minimum(low, high).amax(-1) <= torch.maximum(low, high).amin(-1)
    return 1 - float(hit.float().mean())
