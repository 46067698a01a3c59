"""A tight box around an object, from its silhouettes (space carving; Kutulakos and Seitz 2000, without colours).

c images of h x w pixels, n voxels. NumPy processes each view in one thread: on a busy machine, parallel loops inside
small array operations cost more than the operations themselves.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.nerf.cameras import Cameras, focus_point
from voronerf.nerf.lenses import distort

Array = NDArray[np.float32]

RESOLUTIONS = (24, 32, 48)
MASK_PIXELS, MOST_MASK_PIXELS = 100, 1000  # target length of a mask's shorter side, limit of its longer side
VIEWS = 100
GROWTHS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # mask dilations in pixels
MARGIN = GROWTHS[-1] + 1
SEEN_BY = 0.25  # least fraction of the views that must see a voxel of the object
MISSED_BY = 1  # number of views whose masks may be wrong about a voxel
OUTSIDE = 1e-3  # largest fraction of the masks' pixels whose rays may miss the box


def carve_box(cameras: Cameras, alpha: Tensor, near: float, far: float) -> Tensor | None:
    """Returns the bounding box of the voxels that at most one mask excludes.

    A voxel is removed if two views see it entirely outside their masks, or if fewer than a quarter of the views see it.
    Each mask is dilated by the voxel's size in pixels, so that the box does not cut the object. The box is larger than
    the object by one or two voxels, each about a fortieth of the object's size, and includes concavities that no
    silhouette shows.

    Args:
        cameras: c perspective cameras around the object, which look at it.
        alpha: uint8 [c, h, w]; a pixel with alpha > 0 shows the object. Smaller images are padded with zeros.
        near: smallest distance of the object from a camera.
        far: largest distance of the object; the search covers a cube of half side (far - near) / 2.

    Returns:
        float32 [2, 3], or None if there is no box: nothing or everything is opaque, a lens is not perspective, the
        cameras have no common focus, or the rays of more than a thousandth of the masks' pixels would miss the box.
    """
    stride = -(-len(cameras) // VIEWS)
    cameras, visible = cameras[::stride], (alpha[::stride] > 0).numpy()
    focus = focus_point(cameras)
    if focus is None or cameras.models is not None or not visible.any() or visible.all():
        return None
    shrink = max(1, min(visible.shape[1:]) // MASK_PIXELS, max(visible.shape[1:]) // MOST_MASK_PIXELS)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        views = list(pool.map(lambda index: _Silhouette(cameras, index, visible[index], shrink), range(len(cameras))))
        centre, half = focus.numpy(), np.float32((far - near) / 2)
        box = np.stack((centre - half, centre + half))
        for resolution in RESOLUTIONS:
            carved = _carve(views, pool, box, resolution)
            if carved is None:
                return None
            box = carved
    return torch.from_numpy(box) if _share_outside(cameras, visible, box) <= OUTSIDE else None


class _Silhouette:
    """A camera and its mask, dilated by each width of `GROWTHS`."""

    def __init__(self, cameras: Cameras, index: int, visible: NDArray[np.bool_], shrink: int) -> None:
        width, height = cameras.size(index)
        visible = visible[:height, :width]
        self.pose: Array = cameras.poses[index].numpy()
        self.fx, self.fy, self.cx, self.cy = (cameras.intrinsics[index] / shrink).tolist()
        mask = _block_any(visible, shrink)
        self.height, self.width = mask.shape
        # A view of the whole object also excludes all voxels outside its picture.
        self.shows_all = not _touches_border(mask)
        if cameras.distortion is not None:
            mask = self._straightened(mask, cameras.distortion[index])
            self.shows_all &= not _touches_border(mask)
        mask = np.pad(mask, MARGIN)
        levels = []
        done = 0
        for grow in GROWTHS:
            for _ in range(grow - done):
                mask = _widen(mask)
            levels.append(mask)
            done = grow
        levels.append(np.ones_like(mask))  # for voxels wider than the last dilation
        self.masks = np.stack(levels)

    def _straightened(self, mask: NDArray[np.bool_], coefficients: Tensor) -> NDArray[np.bool_]:
        """Returns the undistorted mask; pixels outside the picture are set unless it shows the whole object."""
        row, column = torch.from_numpy(np.indices(mask.shape) + 0.5)
        u, v = distort((column - self.cx) / self.fx, (row - self.cy) / self.fy, coefficients)
        x, y = (u * self.fx + self.cx).floor().numpy(), (v * self.fy + self.cy).floor().numpy()
        shown = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        straight = np.full(mask.shape, not self.shows_all)
        straight[shown] = mask[y[shown].astype(np.int64), x[shown].astype(np.int64)]
        return straight

    def judge(self, points: Array, radius: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Returns (seen, missed), bool [n]: the balls that this view sees, and the seen balls outside its mask.

        The balls have the centres `points` [n, 3] and one radius.
        """
        x, y, z = (points - self.pose[:3, 3]).T
        local = [self.pose[0, i] * x + self.pose[1, i] * y + self.pose[2, i] * z for i in range(3)]
        depth = -local[2]
        ahead = depth > 2 * radius  # skips balls that reach behind the camera
        safe = np.maximum(depth, radius)
        column = np.floor(self.cx + self.fx * local[0] / safe)
        row = np.floor(self.cy - self.fy * local[1] / safe)
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        seen = ahead & (inside | self.shows_all)
        reach = radius * max(self.fx, self.fy) / np.maximum(depth - radius, radius) + 1
        level = np.searchsorted(np.array(GROWTHS, dtype=np.float32), reach)
        height, width = self.masks.shape[1:]
        column = np.clip(column + MARGIN, 0, width - 1).astype(np.int64)
        row = np.clip(row + MARGIN, 0, height - 1).astype(np.int64)
        return seen, seen & ~self.masks.reshape(-1)[(level * height + row) * width + column]


def _carve(views: list[_Silhouette], pool: ThreadPoolExecutor, box: Array, resolution: int) -> Array | None:
    """Carves a grid of resolution^3 voxels in `box`; returns the box of the remaining voxels."""
    size = (box[1] - box[0]) / np.float32(resolution)
    steps = np.arange(resolution, dtype=np.float32) + np.float32(0.5)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = box[0] + grid * size
    radius = 0.5 * float(np.linalg.norm(size))
    seen, missed = np.zeros(len(points), dtype=np.int32), np.zeros(len(points), dtype=np.int32)
    for view_seen, view_missed in pool.map(lambda view: view.judge(points, radius), views):
        seen += view_seen
        missed += view_missed
    remains = (seen >= SEEN_BY * len(views)) & (missed <= MISSED_BY)
    if not remains.any():
        return None
    kept = points[remains]
    return np.stack((kept.min(axis=0) - size / 2, kept.max(axis=0) + size / 2))


def _block_any(mask: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """Returns for each block whether any pixel is set, with partial blocks at the right and bottom."""
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % size), (0, -width % size)))
    blocks = padded.reshape(padded.shape[0] // size, size, padded.shape[1] // size, size)
    return np.asarray(blocks.any(axis=(1, 3)))


def _touches_border(mask: NDArray[np.bool_]) -> bool:
    """Returns whether any pixel at the border is set."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def _widen(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Dilates a mask by one pixel on each side, corners included."""
    rows = mask.copy()
    rows[1:] |= mask[:-1]
    rows[:-1] |= mask[1:]
    result = rows.copy()
    result[:, 1:] |= rows[:, :-1]
    result[:, :-1] |= rows[:, 1:]
    return result


def _share_outside(cameras: Cameras, visible: NDArray[np.bool_], box: Array) -> float:
    """Returns the fraction of the masks' pixels whose rays miss the box."""
    image, row, column = visible.nonzero()
    step = max(1, len(image) // 20_000)
    chosen = [torch.from_numpy(index[::step].copy()) for index in (image, column, row)]
    rays = cameras.rays(chosen[0], chosen[1], chosen[2])
    corners = torch.from_numpy(box)
    low, high = (corners[0] - rays.origins) / rays.directions, (corners[1] - rays.origins) / rays.directions
    hit = torch.minimum(low, high).amax(-1) <= torch.maximum(low, high).amin(-1)
    return 1 - float(hit.float().mean())
