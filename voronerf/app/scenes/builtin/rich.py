"""The built-in rich scene: hundreds of solids, for ground truth with more detail than a small network holds.

On a mosaic plinth a brick tower in staggered courses under a globe, a helix of marbles around it, a chain of linked
rings, a fence of posts, and small crates. Light, cameras and views are those of the built-in scene.
"""

from __future__ import annotations

import colorsys
import math

from voronerf.app.scenes.builtin.pictures import TEST_VIEWS, TRAIN_VIEWS, hemisphere_scene
from voronerf.app.scenes.builtin.plain import FLOOR
from voronerf.app.scenes.builtin.solids import Box, Cylinder, Solid, Sphere, Torus, rotation
from voronerf.app.scenes.builtin.textures import bricks, checker, diagonals, globe, mosaic, plain, spiral
from voronerf.app.scenes.scene import Scene

COURSES, BRICKS = 16, 12  # of the tower
COURSE, TOWER = 0.06, 0.36  # height of a course and the tower's radius


def rich_scene(size: int = 100, *, train_views: int = TRAIN_VIEWS, test_views: int = TEST_VIEWS) -> Scene:
    """Computes the scene.

    Args:
        size: of the square images, pixels.
        train_views: spread over the upper hemisphere on a spherical Fibonacci lattice.
        test_views: on an orbit that rises and falls twice, apart from the training views.

    Raises:
        ValueError: a size or number of views below 1.

    Examples:
        >>> from voronerf.app.scenes import rich_scene
        >>> scene = rich_scene(4, train_views=3, test_views=1)
        >>> scene.train.images.shape[1:3]
        torch.Size([4, 4])
    """
    return hemisphere_scene("builtin-rich", SOLIDS, size, train_views, test_views)


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
