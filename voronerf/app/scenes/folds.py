"""Signs of what misleads a mapper: a background that stands still, and a thing that looks alike from two sides.

Behind an object on a turntable the background has most features, and shows a camera that does not move. A model is
folded if pictures of two sides of a thing are placed on one of them.

Matches between two sides lie on that thing alone, and it fills little of the pictures. Matches of neighbours reach over
much of them. So the latter are believed, and a model that contradicts them is folded.

f features of an image, m matches of two images. Places are in pixels, as of :func:`voronerf.nerf.lenses.unproject`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.app.scenes.colmap import ColmapImage
from voronerf.nerf.lenses import unproject

Array = NDArray[Any]
Pair = tuple[str, str]

#: Wide pairs have so many matches, in boxes of at least this share of those of all features, in both images. Of a can
#: with the same print on two sides, 326 right pairs and a wrong one are wide, of 835 in all.
WIDE_MATCHES, WIDE = 30, 0.12
#: Wide pairs are strong with this share of the most matches that one of the two images has. Weaker ones may be wrong
#: where patterns repeat: the sound cameras of bonsai contradict 22 of 593 wide pairs, none above .2.
STRONG = 0.25
#: An image without strong pairs is held by so many other pairs.
HOLDING = 2
#: A pair is contradicted if half of its matches lie farther than this from where the cameras have them, in widths of
#: the image.
CONTRADICTED = 0.02
#: A model is folded if it contradicts so many strong pairs, and this share of them.
FOLDED_PAIRS, FOLDED = 3, 0.01
#: A pair of images is still if more than this share of its matches lie within this distance of their median shift, in
#: parts of the longest side of the features. Of bust, beer, fern, fox and mouse at most 2 % of the pairs are, of a head
#: on a turntable 57 %. From this share of them on a background stands still.
SHIFTED, SHIFT, STILL = 0.5, 0.0025, 0.25
#: In the place of zero, where a length divides.
TINY = 1e-12


class Matches(NamedTuple):
    """What COLMAP has matched and found to fit two cameras, by the names of the images."""

    features: dict[str, Array]  # float [f, 2], the places of the features of each image
    pairs: dict[Pair, Array]  # int64 [m, 2], of each pair the features that match


def spreads(matches: Matches) -> dict[Pair, float]:
    """Of each pair the share of the images over which its matches reach, the smaller one of both images."""
    boxes = {name: max(_box(places), TINY) for name, places in matches.features.items()}
    return {
        pair: min(_box(matches.features[name][rows]) / boxes[name] for name, rows in zip(pair, found.T))
        for pair, found in matches.pairs.items()
    }


def _box(places: Array) -> float:
    """The area of a box of places [n, 2], without the 5 % at each border."""
    low, high = np.quantile(places, (0.05, 0.95), axis=0) if len(places) else np.zeros((2, 2))
    return float((high - low).prod())


def still_pairs(matches: Matches) -> tuple[int, int]:
    """How many pairs of images differ by a shift alone in most of their matches, and how many have enough matches."""
    lengths = {name: float(np.ptp(places, axis=0).max()) for name, places in matches.features.items() if len(places)}
    known = {pair: found for pair, found in matches.pairs.items() if len(found) >= WIDE_MATCHES}
    count = 0
    for (a, b), found in known.items():
        moved = matches.features[b][found[:, 1]] - matches.features[a][found[:, 0]]
        off = np.linalg.norm(moved - np.median(moved, axis=0), axis=1)
        count += bool((off < SHIFT * lengths[a]).mean() > SHIFTED)
    return count, len(known)


def wide_pairs(matches: Matches, spread: dict[Pair, float]) -> list[Pair]:
    """The pairs whose matches reach over much of both images."""
    return [pair for pair, found in matches.pairs.items() if len(found) >= WIDE_MATCHES and spread[pair] >= WIDE]


def strong_pairs(matches: Matches, wide: Iterable[Pair]) -> list[Pair]:
    """The wide pairs whose matches are not few beside those of the best pairs of their images."""
    most = dict.fromkeys(matches.features, 0)
    for pair, found in matches.pairs.items():
        most.update({name: max(most[name], len(found)) for name in pair})
    return [(a, b) for a, b in wide if len(matches.pairs[a, b]) >= STRONG * max(most[a], most[b])]


def trusted_pairs(matches: Matches, spread: dict[Pair, float]) -> set[Pair]:
    """The wide pairs and, of an image without strong pairs, the best others by matches times share."""
    wide = set(wide_pairs(matches, spread))
    held = {name for pair in strong_pairs(matches, wide) for name in pair}
    others = [pair for pair, found in matches.pairs.items() if pair not in wide and len(found) >= WIDE_MATCHES]
    others.sort(key=lambda pair: -len(matches.pairs[pair]) * spread[pair])
    bare = matches.features.keys() - held
    return wide.union(*([pair for pair in others if name in pair][:HOLDING] for name in bare))


def contradicted_pairs(matches: Matches, strong: Iterable[Pair], images: Sequence[ColmapImage]) -> tuple[int, int]:
    """How many strong pairs the cameras of a model contradict, and how many its images have."""
    by_name = {image.name: image for image in images}
    known = [pair for pair in strong if by_name.keys() >= set(pair)]
    rays = {name: _rays(by_name[name], matches.features[name]) for name in {name for pair in known for name in pair}}
    count = 0
    for a, b in known:
        rows, camera = torch.from_numpy(matches.pairs[a, b]), by_name[a].camera
        base = torch.from_numpy(by_name[b].pose[:3, 3] - by_name[a].pose[:3, 3])
        angle = float(epipolar_angles(rays[a][rows[:, 0]], rays[b][rows[:, 1]], base).nanmedian())
        count += angle * camera.lens.intrinsics[0] > CONTRADICTED * camera.width
    return count, len(known)


def _rays(image: ColmapImage, places: Array) -> Tensor:
    """Directions of places [f, 2] in the scene, float64 [f, 3]; NaN where the lens has none."""
    x, y = torch.from_numpy(places.astype(np.float64)).unbind(-1)
    intrinsics, coefficients, model = image.camera.lens
    directions, there = unproject(x, y, torch.tensor(intrinsics), torch.tensor(coefficients), model)
    directions[~there] = torch.nan
    return directions @ torch.from_numpy(image.pose[:3, :3]).T


def epipolar_angles(a: Tensor, b: Tensor, base: Tensor) -> Tensor:
    """How far the rays of matches miss each other: angles to the epipolar planes in radians, float64 [m].

    Sampson's distance, as in Hartley and Zisserman 2004, "Multiple View Geometry", 11.4.3, for directions: it is right
    where it is small.

    Args:
        a: [m, 3], directions of unit length from one camera.
        b: [m, 3], from the other one.
        base: [3], from the first camera to the other one.
    """
    across = [torch.linalg.cross(base.expand_as(rays), rays).norm(dim=-1) for rays in (a, b)]
    missed = (torch.linalg.cross(a, b) @ base).abs()
    return missed / torch.hypot(*across).clamp_min(TINY)


def is_folded(contradicted: int, strong: int) -> bool:
    """Whether a model that contradicts some of its strong pairs is folded."""
    return contradicted >= FOLDED_PAIRS and contradicted > FOLDED * strong
