"""Regions of a large scene: boxes that are trained one by one, as separate jobs, and joined.

A region is trained as the inside of an unbounded scene: a contraction leaves the sphere around its box unchanged, and
maps the rest of the scene into a thin shell, which is the background of the region.
Source: Turki et al. 2022, "Mega-NeRF", section 3: the pixels of a region are those whose rays meet its box.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.scene import KnownDepths, Scene
from voronerf.nerf.contraction import Contraction

#: The fraction of a sparse model's points, at each end of each axis, that count as outliers and lie outside all boxes.
STRAYS = 0.002
#: A test view is kept if the rays of at least this fraction of its pixels meet the region, or half of the largest such
#: fraction of a view, whichever is smaller.
SEEN = 0.2


def region_of(scene: Scene, box: Tensor) -> Scene:
    """Returns the scene for the training of a region: the test views that see it, and pixels whose rays meet its box.

    Args:
        scene: The whole scene.
        box: [2, 3], lowest and highest corner of the region.

    Raises:
        SceneError: The box is empty, or no test view sees it.
    """
    if not bool((box[0] < box[1]).all()) or not bool(box.isfinite().all()):
        raise SceneError(f"{scene.name}: region must be x y z of a corner and of a larger one, got {box.tolist()}")
    train, test = scene.train, scene.test
    bounds: dict[str, Any] = {"near": scene.near, "far": scene.far, "box": box}
    if (known := train.sparse_depth) is not None:
        rays = train.cameras.pixel_rays(train.images, known.pixels, **bounds)
        meets = rays.far > rays.near
        train = replace(train, sparse_depth=KnownDepths(known.pixels[meets], known.distances[meets]))
    masks = torch.zeros(len(test), test.cameras.height, test.cameras.width, dtype=torch.bool, device="cpu")
    for view in range(len(test)):
        width, height = test.cameras.size(view)
        _, first, last = test.cameras.image_rays_between(view, **bounds)
        mask = test.mask(view)
        masks[view, :height, :width] = (last > first).view(height, width) & (True if mask is None else mask)
    pixels = torch.tensor([math.prod(test.cameras.size(view)) for view in range(len(test))], device="cpu")
    shares = masks.flatten(1).count_nonzero(1) / pixels
    if not shares.any():
        raise SceneError(f"{scene.name}: region must be seen by a test view, got {box.tolist()}")
    seeing = (shares >= min(SEEN, float(shares.max()) / 2)).nonzero()[:, 0]
    names = tuple(test.names[view] for view in seeing.tolist())
    test = replace(test, cameras=test.cameras[seeing], images=test.images[seeing], names=names, masks=masks[seeing])
    contraction = Contraction(box.mean(0), float((box[1] - box[0]).norm()) / 2)
    return replace(scene, train=train, test=replace(test, on_disk=False), contraction=contraction, region=box)


def tiles(scene: Scene, count: int) -> list[Tensor]:
    """Divides a scene into boxes [2, 3] with equally many points, which fill the box of the scene without gaps.

    The points are the sparse model's or, without a model, the positions of the cameras; a scene without a box gets the
    box of the points. A box is divided along its longest side, as in a k-d tree (Bentley 1975): between points, or in
    the middle if that border is outside the box.

    Args:
        scene: The scene.
        count: The number of boxes, at least 1.

    Raises:
        SceneError: The scene has neither a box nor a sparse model, ``count`` is below 1, or there are fewer points.

    Examples:
        >>> from voronerf.app.scenes import load_scene
        >>> from voronerf.app.scenes.regions import tiles
        >>> [box.shape for box in tiles(load_scene("builtin-city:2x2", downscale=10), 4)]
        [torch.Size([2, 3]), torch.Size([2, 3]), torch.Size([2, 3]), torch.Size([2, 3])]
    """
    cameras, depths = scene.train.cameras, scene.train.sparse_depth
    points = cameras.origins
    if depths is not None:
        directions = cameras.pixel_rays(scene.train.images, depths.pixels, near=scene.near, far=scene.far).directions
        image = depths.pixels // (cameras.width * cameras.height)
        points = cameras.origins[image] + depths.distances[:, None] * directions
    if not 1 <= count <= len(points):
        raise SceneError(f"{scene.name}: count must be 1 to {len(points)}, the number of points, got {count}")
    box = scene.box
    if box is None and depths is None:
        raise SceneError(f"{scene.name}: the scene must have a box or a sparse model to be divided into regions")
    if box is None:
        ends = torch.tensor([STRAYS, 1 - STRAYS], dtype=points.dtype, device="cpu")
        box = torch.quantile(points[:: max(1, len(points) // 1_000_000)], ends, dim=0)
    return _divided(points, box, count)


def _divided(points: Tensor, box: Tensor, count: int) -> list[Tensor]:
    if count == 1:
        return [box]
    axis = int((box[1] - box[0]).argmax())
    order, first = points[:, axis].argsort(), count // 2
    place = len(points) * first // count
    border = points[order[place - 1 : place + 1], axis].mean()
    if not box[0, axis] < border < box[1, axis]:
        border = box[:, axis].mean()
    low, high = box.clone(), box.clone()
    low[1, axis] = high[0, axis] = border
    return _divided(points[order[:place]], low, first) + _divided(points[order[place:]], high, count - first)
