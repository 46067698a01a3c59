"""Checks of reconstructed cameras: lost cameras, collapsed cameras, and implausible lenses.

c cameras, in any coordinates.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from voronerf.app.scenes.lenses import Lens
from voronerf.nerf.lenses import EQUIRECTANGULAR

#: A camera is lost if the distance to its nearest neighbour exceeds `LOST` times the median of these distances, and
#: exceeds the quantile `EXTENT` of the distances between any two cameras. The first condition alone would reject all
#: cameras outside a burst of images. The second condition works for bursts of up to 57 % of the cameras, and for up to
#: 42 % of lost cameras.
LOST, EXTENT = 8.0, 1 / 3
#: Two lost cameras may be each other's nearest neighbours. So a camera is also lost if its distance to the median
#: position exceeds `APART` times the quantile `MOST` of these distances.
APART, MOST = 10.0, 0.8
#: The check for a collapse (see `COLLAPSED`) ignores lost cameras if they are at most this fraction of all cameras, or
#: a single camera. If more cameras count as lost, they may be correct, and the others may have collapsed.
FEW = 0.1
#: The maximum number of cameras whose pairwise distances are measured.
MOST_CAMERAS = 1000
#: Cameras have collapsed, most of them to nearly one point, if (median distance to the nearest neighbour) * (number of
#: cameras) / (mean distance to the centre) is below this ratio. For evenly spaced cameras on a circle, the ratio is 6.
COLLAPSED = 0.05
#: The largest plausible ratio of the largest to the least depth of points.
DEEPEST = 1e4
#: The plausible range of focal lengths in image widths: fields of view of 4 to 127 degrees.
FOCAL_LENGTHS = (0.25, 15.0)
#: The largest plausible magnitudes of three quantities: the relative difference of fx and fy, the first distortion
#: coefficient, and the tangential distortion coefficients p1 and p2.
ASPECT, BENT, TILTED = 0.05, 1.0, 0.05
#: The largest plausible ratio of the focal lengths of one device, relative to the longer sides of its images.
SPREAD = 1.25


#: The maximum number of names in a line.
MOST_NAMED = 8


def lost_cameras(origins: Tensor) -> Tensor:
    """Returns bool [c]: whether cameras at ``origins`` [c, 3] lie far from the others; all False for two or fewer."""
    if len(origins) < 3:
        return origins.new_zeros(len(origins), dtype=torch.bool)
    nearest, some = _nearest(origins), origins[:: len(origins) // MOST_CAMERAS + 1]
    distances = torch.pdist(some)
    alone = (nearest > LOST * nearest.median()) & (nearest > distances.sort().values[int(EXTENT * len(distances))])
    distance = (origins - origins.median(0).values).norm(dim=-1)
    return alone | (distance > APART * distance.sort().values[int(MOST * (len(distance) - 1))])


def camera_faults(
    origins: Tensor, bounds: Tensor | None = None, lenses: Iterable[tuple[Lens, float]] = ()
) -> list[str]:
    """Returns phrases that describe the faults of cameras, for a message; an empty list for plausible cameras.

    Args:
        origins: [c, 3], positions of the cameras.
        bounds: [m, 2], least and largest depths of the points of m views, without outliers; None if unknown.
        lenses: pairs of a lens and the width of its images in pixels.
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


def spread_of_lenses(lenses: Sequence[tuple[Lens, float]]) -> str:
    """Returns a phrase if every image has a lens of its own and the focal lengths differ much; otherwise "".

    Args:
        lenses: the lens of each image, and the longer side of the image in pixels.
    """
    lengths = [lens.intrinsics[0] / side for lens, side in lenses if lens.model != EQUIRECTANGULAR]
    least, largest = min(lengths, default=1.0), max(lengths, default=1.0)
    if len({lens for lens, _ in lenses}) < max(len(lenses), 3) or largest < SPREAD * least:
        return ""
    return (
        f"each of {len(lenses)} images has its own lens, with focal lengths from {least:.2f} to {largest:.2f} of the "
        "longer side; this is unlikely unless the camera zoomed or the images were cropped"
    )


def some_of(names: list[str]) -> str:
    """Returns a line with the first `MOST_NAMED` names, and with the number of the other names."""
    more = [f"{len(names) - MOST_NAMED} more"] * (len(names) > MOST_NAMED)
    return ", ".join(names[:MOST_NAMED] + more)


def _nearest(origins: Tensor) -> Tensor:
    """Returns the distance of each camera to its nearest neighbour, [c]."""
    nearest, numbers = origins.new_empty(len(origins)), torch.arange(len(origins), device=origins.device)
    for rows in numbers.split(1024):
        distances = torch.cdist(origins[rows], origins)
        distances[numbers[: len(rows)], rows] = float("inf")
        nearest[rows] = distances.amin(1)
    return nearest
