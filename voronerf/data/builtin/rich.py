"""The built-in rich scene: hundreds of solids, for ground truth with more detail than a small network holds.

On a mosaic plinth a brick tower in staggered courses under a globe, a helix of marbles around it, a chain of linked
rings, a fence of posts, and small crates. Light, cameras and views are those of the built-in scene. Rays are cast by
`voronerf.ops.cast_solids`: by Warp where it is installed, which takes seconds on the CPU, else by NumPy, which takes
several times as long; the two round differently, so that single pixels may differ by a level.
"""

from __future__ import annotations

import colorsys
import functools
import math
from collections.abc import Sequence

import numpy as np
import torch

from voronerf import backends
from voronerf.data.builtin.opaque import (
    SUPERSAMPLES,
    TEST_VIEWS,
    TRAIN_VIEWS,
    Hits,
    bounds,
    builtin_cameras,
    render_scene,
    see,
)
from voronerf.data.builtin.opaque_solids import FLOOR, bricks, checker, diagonals, globe, mosaic, plain, spiral
from voronerf.data.builtin.solids import Array, Box, Cylinder, Rows, Solid, Sphere, Torus, first_hits, rotation
from voronerf.data.scene import Scene
from voronerf.ops.cast_solids import cast_solids

KINDS: tuple[type[Solid], ...] = (Sphere, Box, Cylinder, Torus)  # in the order of the op's numbers
COURSES, BRICKS = 16, 12  # of the tower
COURSE, TOWER = 0.06, 0.36  # height of a course and the tower's radius


def rich_scene(
    size: int = 100,
    *,
    train_views: int = TRAIN_VIEWS,
    test_views: int = TEST_VIEWS,
    backend: str = "auto",
) -> Scene:
    """Computes the scene.

    Args:
        size: of the square images, pixels.
        train_views: spread over the upper hemisphere on a spherical Fibonacci lattice.
        test_views: on an orbit that rises and falls twice, apart from the training views.
        backend: "warp", "reference" (the op's), "numpy", or "auto": Warp where it is installed, else NumPy.

    Raises:
        ValueError: a size or number of views below 1, or an unknown backend.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> from voronerf.data import rich_scene
        >>> scene = rich_scene(4)
        >>> scene.train.images.shape[1:3]
        torch.Size([4, 4])
    """
    cameras = builtin_cameras("rich_scene", size, train_views, test_views)
    look = functools.partial(see, solids=SOLIDS, hits=caster(SOLIDS, backend))
    return render_scene("builtin-rich", cameras, look, bounds(SOLIDS), SUPERSAMPLES)


def caster(solids: Sequence[Solid], backend: str = "auto") -> Hits:
    """What finds the first solid on a ray.

    Args:
        solids: of the kinds of `KINDS`.
        backend: as of `rich_scene`.
    """
    if backend == "auto":
        backend = "numpy" if backends.why_not("cast_solids", "warp", torch.device("cpu")) else "warp"
    if backend == "numpy":
        return functools.partial(first_hits, solids)
    tables = tables_of(solids)

    def hits(origins: Array, directions: Array) -> tuple[Array, Rows]:
        rays = (torch.from_numpy(np.ascontiguousarray(v)) for v in np.broadcast_arrays(origins, directions))
        depths, found = cast_solids(*tables, *rays, backend=backend)
        return depths.numpy(), found.clamp(min=0).numpy().astype(np.int64)

    # Compile kernels before several threads need them.
    hits(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return hits


def tables_of(solids: Sequence[Solid]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(kinds, frames, sizes) of solids, as `voronerf.ops.cast_solids` takes them."""
    kinds = [KINDS.index(type(solid)) for solid in solids]
    turns = [np.eye(3, dtype=np.float32) if solid.turn is None else solid.turn for solid in solids]
    frames = [np.vstack((turn, np.array(solid.centre))) for turn, solid in zip(turns, solids)]
    sizes = torch.tensor([_size(solid) for solid in solids], dtype=torch.float32)
    return torch.tensor(kinds, dtype=torch.int32), torch.from_numpy(np.stack(frames).astype(np.float32)), sizes


def _size(solid: Solid) -> tuple[float, float, float]:
    if isinstance(solid, Sphere):
        return solid.radius, 0.0, 0.0
    if isinstance(solid, Box):
        return solid.half
    if isinstance(solid, Cylinder):
        return solid.radius, solid.half_height, 0.0
    assert isinstance(solid, Torus)
    return solid.ring, solid.tube, 0.0


def _hue(share: float, value: float = 0.9, saturation: float = 0.7) -> tuple[float, float, float]:
    return colorsys.hsv_to_rgb(share % 1, saturation, value)


def _around(share: float, radius: float, height: float) -> tuple[float, float, float]:
    """A point at a share of the full turn around the z axis, above the floor."""
    angle = 2 * math.pi * share
    return radius * math.cos(angle), radius * math.sin(angle), FLOOR + height


def _tower() -> list[Solid]:
    """Staggered courses of bricks, a drum inside them, battlements, and a globe on top."""
    parts: list[Solid] = [
        Cylinder((0, 0, FLOOR + 0.5), plain((0.30, 0.27, 0.25)), 0.05, 10, radius=0.31, half_height=0.5)
    ]
    half = (0.042, math.pi * TOWER / BRICKS - 0.008, COURSE / 2 - 0.005)
    for course in range(COURSES):
        for brick in range(BRICKS):
            share = (brick + 0.5 * (course % 2)) / BRICKS
            clay = _hue(
                0.02 + 0.05 * math.sin(7.3 * brick + 3.1 * course), 0.62 + 0.2 * math.cos(5.7 * brick + course), 0.6
            )
            turn = rotation("z", 360 * share)  # the brick's x axis looks outwards
            parts.append(Box(_around(share, TOWER, (course + 0.5) * COURSE), plain(clay), 0.1, 12, turn, half=half))
    for merlon in range(8):
        turn = rotation("z", 45.0 * merlon)
        place = _around(merlon / 8, 0.33, COURSES * COURSE + 0.06)
        parts.append(Box(place, diagonals, 0.15, 12, turn, half=(0.05, 0.06, 0.06)))
    parts.append(Sphere((0, 0, FLOOR + 1.2), globe, 0.45, 30, radius=0.2))
    return parts


def _solids() -> tuple[Solid, ...]:
    """Everything in the scene."""
    parts: list[Solid] = [Cylinder((0, 0, FLOOR - 0.08), mosaic, 0.08, 10, radius=1.18, half_height=0.08), *_tower()]
    for index in range(64):
        share = index / 64
        place = _around(2.5 * share, 0.56 - 0.08 * share, 0.06 + 1.15 * share)
        parts.append(Sphere(place, plain(_hue(3 * share)), 0.6, 40, radius=0.035 + 0.015 * math.cos(9.1 * index)))
    for link in range(30):
        tilt = rotation("z", 12.0 * link) @ rotation("x", 90.0 * (link % 2))
        parts.append(Torus(_around(link / 30, 0.78, 0.09), spiral, 0.5, 30, tilt, ring=0.066, tube=0.019))
    for post in range(36):
        place = _around(post / 36, 1.1, 0.11)
        parts.append(Cylinder(place, plain(_hue(post / 36, 0.8, 0.35)), 0.2, 20, radius=0.018, half_height=0.11))
        parts.append(Sphere((*place[:2], place[2] + 0.13), plain(_hue(post / 36)), 0.6, 40, radius=0.03))
    for crate in range(7):
        place = _around((crate + 0.3) / 7, 0.95, 0.055)
        parts.append(Box(place, diagonals, 0.15, 12, rotation("z", 37.0 * crate), half=(0.055, 0.055, 0.055)))
        parts.append(Sphere((*place[:2], place[2] + 0.1), checker, 0.55, 40, radius=0.045))
    parts.append(Cylinder(_around(0.62, 0.95, 0.05), bricks, 0.1, 10, radius=0.07, half_height=0.05))
    return tuple(parts)


SOLIDS = _solids()
