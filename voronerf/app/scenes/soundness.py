"""Checks of the cameras of photographs: signs of a reconstruction that has collapsed.

c cameras, in any coordinates.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from voronerf.app.scenes.lenses import Lens
from voronerf.nerf.lenses import EQUIRECTANGULAR

#: A camera is lost if its nearest neighbour is farther than this many times the median distance between neighbours, and
#: than this share of the distances between all cameras. The first alone would call all lost that stand beside a burst;
#: bursts of up to 57 % of the cameras leave the second, and so do 42 % that are lost.
LOST, EXTENT = 8.0, 1 / 3
#: Cameras that are lost together are neighbours of each other. So lost are also those that are this many times as far
#: from the middle of all as this share of the cameras is at the most.
APART, MOST = 10.0, 0.8
#: Up to this share of lost cameras, or one, the others are judged alone. More may be what a collapse left.
FEW = 0.1
#: Cameras that are drawn to measure the distances between all.
MOST_CAMERAS = 1000
#: Cameras have collapsed if their median distance to the nearest other one, times their number, is below this share of
#: their mean distance to the middle. Cameras that are spread evenly on a circle have 6.
COLLAPSED = 0.05
#: The largest ratio of the depths that the cameras see.
DEEPEST = 1e4
#: Focal lengths over the width of an image: fields of view of 4 to 127 degrees.
FOCAL_LENGTHS = (0.25, 15.0)
#: How much the focal lengths of the two axes may differ, and how large the first coefficient of a lens and those of its
#: tilt (p1, p2) may be.
ASPECT, BENT, TILTED = 0.05, 1.0, 0.05


#: Cameras that a line names.
MOST_NAMED = 8


def lost_cameras(origins: Tensor) -> Tensor:
    """Which cameras [c, 3] lie far away from the others, bool [c]; of two, none."""
    if len(origins) < 3:
        return torch.zeros(len(origins), dtype=torch.bool)
    nearest, some = _nearest(origins), origins[:: len(origins) // MOST_CAMERAS + 1]
    apart = torch.pdist(some)
    alone = (nearest > LOST * nearest.median()) & (nearest > apart.sort().values[int(EXTENT * len(apart))])
    distance = (origins - origins.median(0).values).norm(dim=-1)
    return alone | (distance > APART * distance.sort().values[int(MOST * (len(distance) - 1))])


def camera_faults(
    origins: Tensor, bounds: Tensor | None = None, lenses: Iterable[tuple[Lens, float]] = ()
) -> list[str]:
    """The faults of cameras, as parts of a line; empty if they are sound.

    Args:
        origins: [c, 3], their positions.
        bounds: [m, 2], the least and the largest depth of what they see, outliers left out; None if it is unknown.
        lenses: each with the width of its images in pixels.
    """
    faults = []
    if len(origins) >= 3:
        lost = lost_cameras(origins)
        origins = origins[~lost] if int(lost.sum()) <= max(1, FEW * len(lost)) else origins
        near = float(_nearest(origins).median())
        extent = float((origins - origins.mean(0)).norm(dim=-1).mean())
        if near * len(origins) < COLLAPSED * extent:
            where = f"half of them lie within {near:.3g} of another one, and {extent:.3g} from the middle"
            faults.append(f"the cameras have collapsed: {where}")
    if bounds is not None and len(bounds):
        near, far = float(bounds[:, 0].min()), float(bounds[:, 1].max())
        if far > DEEPEST * near:
            faults.append(f"the points lie at depths from {near:.3g} to {far:.3g}")
    for lens, width in dict.fromkeys(lenses):
        if lens.model == EQUIRECTANGULAR:
            continue
        fx, fy, *_ = lens.intrinsics
        if not FOCAL_LENGTHS[0] <= fx / width <= FOCAL_LENGTHS[1]:
            faults.append(f"a focal length of {fx / width:.3g} image widths is unlikely")
        elif abs(fy / fx - 1) > ASPECT:
            faults.append(f"the focal lengths of the two axes differ, {fx:.4g} and {fy:.4g}")
        elif abs(lens.coefficients[0]) > BENT:
            faults.append(f"the first coefficient of a lens is {lens.coefficients[0]:.3g}")
        elif max(abs(tilt) for tilt in lens.coefficients[2:4]) > TILTED:
            faults.append(f"a lens is tilted, p1 {lens.coefficients[2]:.3g} and p2 {lens.coefficients[3]:.3g}")
    return list(dict.fromkeys(faults))


def some_of(names: list[str]) -> str:
    """The first `MOST_NAMED` of some names, and how many more there are."""
    more = [f"{len(names) - MOST_NAMED} more"] * (len(names) > MOST_NAMED)
    return ", ".join(names[:MOST_NAMED] + more)


def _nearest(origins: Tensor) -> Tensor:
    """The distance of each camera to the nearest other one, [c]."""
    nearest = torch.empty(len(origins), dtype=origins.dtype)
    for rows in torch.arange(len(origins)).split(1024):
        distances = torch.cdist(origins[rows], origins)
        distances[torch.arange(len(rows)), rows] = float("inf")
        nearest[rows] = distances.amin(1)
    return nearest
