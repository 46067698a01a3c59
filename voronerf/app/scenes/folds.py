"""Checks for images that mislead a mapper: a static background, and an object that looks alike from two sides.

If an object turns in front of a static background, most features lie on the background, and the mapper finds a camera
at rest. A model is folded if its cameras for images of two sides of an object all lie on one side.

False matches between two sides lie on the object alone, which fills a small part of the images. Matches of neighbouring
images spread over a large part; such pairs of images are called wide. Wide pairs are trusted, and a model that
contradicts them is folded.

f features of an image, m matches of two images. Positions are in pixels, as in :func:`voronerf.nerf.lenses.unproject`.
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

#: The minimum number of matches of a wide pair, and the minimum area of their bounding box in both images, as a
#: fraction of the box of all features. For a can with the same print on two sides, 327 of 835 pairs are wide, and one
#: of these is wrong.
WIDE_MATCHES, WIDE = 30, 0.12
#: A wide pair is strong if it has at least `STRONG` times as many matches as every other pair with one of its images.
#: Weaker pairs may be wrong where patterns repeat: in the capture bonsai, good cameras contradict 22 of 593 wide pairs,
#: each of which has at most 0.2 times as many matches as another pair with one of its images.
STRONG = 0.25
#: The number of pairs that are trusted, in addition to all wide pairs, for each image without strong pairs.
HOLDING = 2
#: The median epipolar distance of a pair's matches, in image widths, above which the cameras contradict the pair.
CONTRADICTED = 0.02
#: A folded model contradicts at least this number of strong pairs, and more than this fraction of them.
FOLDED_PAIRS, FOLDED = 3, 0.01
#: A pair of images is still if more than the fraction `SHIFTED` of its matches have nearly the same shift: a match
#: counts if its shift differs from the pair's median shift by less than `SHIFT` times the longer side of the features'
#: box. The background is static if the fraction of still pairs exceeds `STILL`. In the captures bust, beer, fern, fox
#: and mouse, at most 2 % of the pairs are still; in images of a head on a turntable, 57 % are.
SHIFTED, SHIFT, STILL = 0.5, 0.0025, 0.25
#: The smallest divisor, in place of a length of zero.
TINY = 1e-12


class Matches(NamedTuple):
    """COLMAP's geometrically verified matches, by image name; the matches of a pair fit one relative pose."""

    features: dict[str, Array]  # float [f, 2], the positions of each image's features
    pairs: dict[Pair, Array]  # int64 [m, 2], the indices of each pair's matching features


def spreads(matches: Matches) -> dict[Pair, float]:
    """Returns the spread of each pair's matches.

    The spread in one image is (area of the box of the matches) / (area of the box of all features). A pair has the
    smaller value of its two images.
    """
    boxes = {name: max(_box(places), TINY) for name, places in matches.features.items()}
    return {
        pair: min(_box(matches.features[name][indices]) / boxes[name] for name, indices in zip(pair, rows.T))
        for pair, rows in matches.pairs.items()
    }


def _box(places: Array) -> float:
    """Returns the area of the box between the 5 % and 95 % quantiles of positions [n, 2]."""
    low, high = np.quantile(places, (0.05, 0.95), axis=0) if len(places) else np.zeros((2, 2))
    return float((high - low).prod())


def still_pairs(matches: Matches) -> tuple[int, int]:
    """Returns (number of still pairs, whose matches have nearly equal shifts; number of pairs with enough matches)."""
    lengths = {name: float(np.ptp(places, axis=0).max()) for name, places in matches.features.items() if len(places)}
    large = {pair: rows for pair, rows in matches.pairs.items() if len(rows) >= WIDE_MATCHES}
    count = 0
    for (a, b), rows in large.items():
        shifts = matches.features[b][rows[:, 1]] - matches.features[a][rows[:, 0]]
        deviations = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
        count += bool((deviations < SHIFT * lengths[a]).mean() > SHIFTED)
    return count, len(large)


def wide_pairs(matches: Matches, spread: dict[Pair, float]) -> list[Pair]:
    """Returns the pairs whose matches spread over a large part of both images."""
    return [pair for pair, rows in matches.pairs.items() if len(rows) >= WIDE_MATCHES and spread[pair] >= WIDE]


def strong_pairs(matches: Matches, wide: Iterable[Pair]) -> list[Pair]:
    """Returns the wide pairs with at least `STRONG` times the matches of every pair that shares an image with them."""
    most = dict.fromkeys(matches.features, 0)
    for pair, rows in matches.pairs.items():
        most.update({name: max(most[name], len(rows)) for name in pair})
    return [(a, b) for a, b in wide if len(matches.pairs[a, b]) >= STRONG * max(most[a], most[b])]


def trusted_pairs(matches: Matches, spread: dict[Pair, float]) -> set[Pair]:
    """Returns the wide pairs and, for each image without strong pairs, its `HOLDING` best other pairs.

    Pairs are ranked by (number of matches) * spread.
    """
    wide = set(wide_pairs(matches, spread))
    covered = {name for pair in strong_pairs(matches, wide) for name in pair}
    others = [pair for pair, rows in matches.pairs.items() if pair not in wide and len(rows) >= WIDE_MATCHES]
    others.sort(key=lambda pair: -len(matches.pairs[pair]) * spread[pair])
    bare = matches.features.keys() - covered
    return wide.union(*([pair for pair in others if name in pair][:HOLDING] for name in bare))


def contradicted_pairs(matches: Matches, strong: Iterable[Pair], images: Sequence[ColmapImage]) -> tuple[int, int]:
    """Returns (number of strong pairs that a model's cameras contradict, number of all strong pairs of its images)."""
    by_name = {image.name: image for image in images}
    placed = [pair for pair in strong if by_name.keys() >= set(pair)]
    rays = {name: _rays(by_name[name], matches.features[name]) for name in {name for pair in placed for name in pair}}
    count = 0
    for a, b in placed:
        rows, camera = torch.from_numpy(matches.pairs[a, b]), by_name[a].camera
        base = torch.from_numpy(by_name[b].pose[:3, 3] - by_name[a].pose[:3, 3])
        angle = float(epipolar_angles(rays[a][rows[:, 0]], rays[b][rows[:, 1]], base).nanmedian())
        count += angle * camera.lens.intrinsics[0] > CONTRADICTED * camera.width
    return count, len(placed)


def _rays(image: ColmapImage, places: Array) -> Tensor:
    """Returns the world ray directions float64 [f, 3] of image positions [f, 2]; NaN where the lens has no ray."""
    x, y = torch.from_numpy(places.astype(np.float64)).unbind(-1)
    intrinsics, coefficients, model = image.camera.lens
    lens = [torch.tensor(values, dtype=torch.float32, device="cpu") for values in (intrinsics, coefficients)]
    directions, valid = unproject(x, y, lens[0], lens[1], model)
    directions[~valid] = torch.nan
    return directions @ torch.from_numpy(image.pose[:3, :3]).T


def epipolar_angles(a: Tensor, b: Tensor, base: Tensor) -> Tensor:
    """Returns the angles by which the rays of matches miss each other's epipolar planes, in radians, float64 [m].

    This is Sampson's distance (Hartley and Zisserman 2004, "Multiple View Geometry", 11.4.3) for directions. It is
    accurate for small angles.

    Args:
        a: [m, 3], unit directions of rays from the first camera.
        b: [m, 3], unit directions of rays from the second camera.
        base: [3], vector from the first to the second camera.
    """
    across = [torch.linalg.cross(base.expand_as(rays), rays).norm(dim=-1) for rays in (a, b)]
    missed = (torch.linalg.cross(a, b) @ base).abs()
    return missed / torch.hypot(*across).clamp_min(TINY)


def is_folded(contradicted: int, strong: int) -> bool:
    """Returns whether a model is folded, given its numbers of contradicted and of all strong pairs."""
    return contradicted >= FOLDED_PAIRS and contradicted > FOLDED * strong
