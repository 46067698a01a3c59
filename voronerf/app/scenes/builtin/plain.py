"""The built-in scene: solids ray-cast from formulas, so it needs no download.

A mosaic plinth carries a sphere, a box, a drum and a column with a ring and a globe, in a circle of marbles. The scene
has fine textures, sharp edges, hard shadows and view-dependent highlights. The images have a supersampled alpha
channel. Units, axes and camera distance match the Blender synthetic scenes.
"""

from __future__ import annotations

import colorsys
import math

import torch
from torch import Tensor

from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.pictures import LIGHT, bounds, keep_in_store, render_views
from voronerf.app.scenes.builtin.solids import Box, Cylinder, Solid, Sphere, Torus, rotation
from voronerf.app.scenes.builtin.textures import barber_pole, bricks, checker, diagonals, globe, mosaic, plain, spiral
from voronerf.app.scenes.scene import Scene
from voronerf.nerf.cameras import Cameras, look_at

FLOOR = -0.46  # height of the plinth's top
TRAIN_VIEWS, TEST_VIEWS = 100, 25
DISTANCE = 4.0
ANGLE_X = 0.6911112  # horizontal field of view of the Blender scenes, radians
NEAR, FAR = 2.0, 6.0
FORMULA = 1  # version of the scene's content; increase it with each change to invalidate stored images


def builtin_scene(
    size: int = 100, *, train_views: int = TRAIN_VIEWS, test_views: int = TEST_VIEWS, images: str = "memory"
) -> Scene:
    """Computes the built-in scene.

    Args:
        size: width and height of the images, in pixels.
        train_views: number of training views, on a spherical Fibonacci lattice over the upper hemisphere.
        test_views: number of test views, on an orbit that rises and falls twice.
        images: "memory" holds the images in memory; "cached" also stores them in the cache directory for later calls.

    Raises:
        ValueError: `size` or a number of views is below 1, or `images` is invalid.
        SceneError: the images cannot be stored.

    Examples:
        >>> from voronerf.app.scenes import builtin_scene
        >>> scene = builtin_scene(8)
        >>> scene.train.cameras.width, len(scene.train), len(scene.test)
        (8, 100, 25)
    """
    if min(size, train_views, test_views) < 1:
        raise ValueError(
            f"builtin: size, train_views and test_views must be >= 1, got {size}, {train_views} and {test_views}"
        )
    if images not in ("memory", "cached"):
        raise ValueError(f"builtin: images must be memory or cached, got {images!r:.60}")
    numbers = torch.arange(max(train_views, test_views), dtype=torch.float32, device="cpu")
    height = (numbers[:train_views] + 0.5) / train_views
    golden = math.pi * (3 - math.sqrt(5))
    turn = 2 * math.pi * numbers[:test_views] / test_views
    train = _cameras(torch.asin(0.02 + 0.96 * height), golden * numbers[:train_views], size)
    test = _cameras(torch.deg2rad(28 + 16 * torch.sin(2 * turn)), turn + 0.05, size)
    caster = Caster(SOLIDS, LIGHT)
    train_split, test_split = (
        render_views(cameras, part, caster, keep_in_store(f"builtin-{part}", [size, len(cameras)], FORMULA, images))
        for part, cameras in (("train", train), ("test", test))
    )
    box = torch.from_numpy(bounds(SOLIDS))
    return Scene(name="builtin", train=train_split, test=test_split, near=NEAR, far=FAR, box=box, background="white")


def _cameras(elevation: Tensor, azimuth: Tensor, size: int) -> Cameras:
    around = torch.stack((elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()), dim=-1)
    poses = look_at(DISTANCE * around, around.new_zeros(3), around.new_tensor((0.0, 0.0, 1.0)))
    focal = 0.5 * size / math.tan(0.5 * ANGLE_X)
    return Cameras(poses, poses.new_tensor((focal, focal, size / 2, size / 2)).repeat(len(poses), 1), size, size)


def _solids() -> tuple[Solid, ...]:
    """Returns all solids of the scene."""
    parts: list[Solid] = [
        Cylinder((0, 0, FLOOR - 0.08), mosaic, 0.08, 10, radius=1.18, half_height=0.08),
        Sphere((0.62, 0.30, FLOOR + 0.36), checker, 0.55, 40, rotation("x", 24), radius=0.36),
        Box((-0.60, 0.38, FLOOR + 0.30), diagonals, 0.15, 12, rotation("z", 28), half=(0.27, 0.27, 0.30)),
        Cylinder((-0.02, -0.70, FLOOR + 0.21), bricks, 0.10, 10, radius=0.31, half_height=0.21),
        Cylinder((0, 0, FLOOR + 0.50), barber_pole, 0.25, 20, radius=0.13, half_height=0.50),
        Sphere((0, 0, FLOOR + 1.22), globe, 0.45, 30, radius=0.24),
        Torus((0, 0, FLOOR + 0.66), spiral, 0.40, 30, rotation("x", -20), ring=0.38, tube=0.105),
    ]
    count = 12
    for index in range(count):
        azimuth = 2 * math.pi * (index + 0.5) / count
        colour = colorsys.hsv_to_rgb(index / count, 0.75, 0.92)
        place = (1.05 * math.cos(azimuth), 1.05 * math.sin(azimuth), FLOOR + 0.095)
        parts.append(Sphere(place, plain(colour), 0.6, 40, radius=0.095))
    return tuple(parts)


SOLIDS = _solids()
