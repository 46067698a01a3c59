"""The built-in city: a test scene of any number of blocks at constant detail.

A block is one scene unit wide and holds about 90 solids: buildings with detailed facades, trees, lamps and parked cars.
Each block adds the same number of views, half of them from its streets and half from above. The background is white.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import torch

from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.city_solids import city
from voronerf.app.scenes.builtin.pictures import LIGHT, bounds, keep_in_store, render_views
from voronerf.app.scenes.builtin.solids import Array, rotation
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.scene import Scene, Split
from voronerf.nerf.cameras import Cameras, look_at

TRAIN_VIEWS, TEST_VIEWS = 40, 8  # views per block; half of them are from the street
MOST = 32  # maximum number of blocks on a side
FORMULA = 1  # version of the city's content; increase it with each change to invalidate stored images
NEAR = 0.02
STREET_ANGLE, ABOVE_ANGLE = 1.2, 0.75  # fields of view, radians


def city_scene(
    size: int = 100,
    *,
    blocks: int | tuple[int, int] = 1,
    train_views: int = TRAIN_VIEWS,
    test_views: int = TEST_VIEWS,
    images: str = "memory",
) -> Scene:
    """Computes the built-in city.

    Args:
        size: width and height of the images, in pixels.
        blocks: number of blocks on each side, or along x and along y, 1 to 32.
        train_views: number of training views per block, alternately from its streets and from above.
        test_views: number of test views per block, at other positions than the training views.
        images: "memory" holds the images in memory; "cached" also stores them in the cache directory for later calls;
            "disk" stores them there and memory-maps them.

    Raises:
        ValueError: `size` or a number of views is below 1, or `blocks` or `images` is invalid.
        SceneError: the images cannot be stored.

    Examples:
        >>> from voronerf.app.scenes import city_scene
        >>> scene = city_scene(4, blocks=2, train_views=2, test_views=1)
        >>> scene.name, len(scene.train), len(scene.test)
        ('builtin-city-2x2', 8, 4)
    """
    for name, value in (("size", size), ("train_views", train_views), ("test_views", test_views)):
        if value < 1:
            raise ValueError(f"city_scene: {name} must be >= 1, got {value}")
    sides = (blocks, blocks) if isinstance(blocks, int) else tuple(blocks)
    if len(sides) != 2 or not 1 <= min(sides) <= max(sides) <= MOST:
        raise ValueError(f"city_scene: blocks must be 1 to {MOST}, got {blocks}")
    if images not in ("memory", "cached", "disk"):
        raise ValueError(f"city_scene: images must be memory, cached or disk, got {images!r:.60}")
    solids, name = city(sides), f"builtin-city-{sides[0]}x{sides[1]}"
    sides_key = sides[0] if sides[0] == sides[1] else list(sides)
    caster = Caster(solids, LIGHT)

    def views(part: str, seed: int, count: int) -> Split:
        cameras = city_cameras(size, sides, count, seed)
        keep = keep_in_store(f"{name}-{part}", [sides_key, size, count, seed], FORMULA, images)
        return replace(render_views(cameras, part, caster, keep), on_disk=images == "disk")

    train, test = views("train", 0, train_views), views("test", 1, test_views)
    box, far = torch.from_numpy(bounds(solids)), math.hypot(*sides) + 3
    return Scene(name=name, train=train, test=test, near=NEAR, far=far, box=box, background="white")


def city_of(size: int, text: str, images: str) -> Scene:
    """Computes a city whose blocks are given as `text`, such as "4x8"; caches the images of several blocks."""
    match = re.fullmatch(r"([1-9]\d?)x([1-9]\d?)", text)
    if match is None or max(int(match[1]), int(match[2])) > MOST:
        raise SceneError(f"builtin-city: blocks must be 1x1, 2x2, 2x4, ... or {MOST}x{MOST}, got {text!r:.60}")
    where = "disk" if images == "disk" else "memory" if text == "1x1" else "cached"
    return city_scene(size, blocks=(int(match[1]), int(match[2])), images=where)


def city_cameras(size: int, blocks: tuple[int, int], views: int, seed: int) -> Cameras:
    """Returns the cameras block by block, alternately from the middle of a street and from above the roofs."""
    random = np.random.default_rng((seed, 2))
    eyes, aims, angles = [], [], []
    for row in range(blocks[1]):
        for column in range(blocks[0]):
            middle = np.array((column + 0.5 - blocks[0] / 2, row + 0.5 - blocks[1] / 2, 0))
            for view in range(views):
                eye, aim = (_in_the_street if view % 2 == 0 else _above)(random)
                eyes.append(middle + eye)
                aims.append(middle + aim)
                angles.append(STREET_ANGLE if view % 2 == 0 else ABOVE_ANGLE)
    origins = torch.from_numpy(np.stack(eyes)).float()
    poses = look_at(origins, torch.from_numpy(np.stack(aims)).float(), origins.new_tensor((0.0, 0.0, 1.0)))
    focal = 0.5 * size / (0.5 * origins.new_tensor(angles)).tan()
    middles = torch.full_like(focal, size / 2)
    return Cameras(poses, torch.stack((focal, focal, middles, middles), dim=1), size, size)


def _in_the_street(random: np.random.Generator) -> tuple[Array, Array]:
    """Draws a camera position near the middle of a street and a target along the street or at the houses."""
    along, off, height = random.uniform(-0.5, 0.5), random.uniform(0.47, 0.5), random.uniform(0.05, 0.16)
    turn, climb = random.uniform(-0.1, 1.2), random.uniform(-0.12, 0.25)
    eye = np.array((along, -off, height))
    gaze = np.array((-np.sign(along) * np.cos(turn), np.sin(turn), climb))
    side = rotation("z", 90.0 * int(random.integers(4)))
    return np.float32(side @ eye), np.float32(side @ (eye + gaze))


def _above(random: np.random.Generator) -> tuple[Array, Array]:
    """Draws a camera position above all roofs and a target inside the block."""
    aim = np.array((*random.uniform(-0.4, 0.4, size=2), 0.12))
    azimuth, climb, distance = random.uniform(0, 2 * np.pi), random.uniform(0.5, 1.25), random.uniform(1.5, 2.3)
    away = np.array((np.cos(climb) * np.cos(azimuth), np.cos(climb) * np.sin(azimuth), np.sin(climb)))
    return np.float32(aim + distance * away), np.float32(aim)
