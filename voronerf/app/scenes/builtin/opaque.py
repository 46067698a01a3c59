"""The built-in scene: ray-cast from formulas, so that everything runs with no download.

A mosaic plinth carries a sphere, a box, a drum and a column with a ring and a globe, among a circle of marbles: fine
texture spread over space, sharp edges, hard shadows (which views share) and highlights (which move with the view).
Images have alpha, by supersampling. Units, axes and camera distance are those of Blender synthetic scenes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.opaque_solids import SOLIDS
from voronerf.app.scenes.builtin.solids import Array, Solid, normalised, slab, turned
from voronerf.app.scenes.scene import Scene, Split
from voronerf.nerf.cameras import Cameras, look_at

TRAIN_VIEWS, TEST_VIEWS = 100, 25
DISTANCE = 4.0
ANGLE_X = 0.6911112  # horizontal field of view of the Blender scenes, radians
NEAR, FAR = 2.0, 6.0
SUPERSAMPLES = 3  # on each side of a pixel
LIGHT = normalised(np.array(((0.45, -0.55, 0.70),), dtype=np.float32))
AMBIENT_DOWN, AMBIENT_UP, DIFFUSE = 0.46, 0.64, 0.50
BAND = 1 << 16  # rays at a time, so that their arrays stay in the cache
# from origins [r, 3], or one [1, 3], and unit directions [r, 3] to premultiplied colour and opacity, [r, 4]
See = Callable[[Array, Array], Array]
# from a shape [c, h, w, 4] and a function that makes image i to the images
Keep = Callable[[tuple[int, int, int, int], Callable[[int], NDArray[np.uint8]]], Tensor]
LIFT = 2e-3  # a shadow's ray starts this far above the surface
CASTER = Caster([SOLIDS])


def builtin_scene(size: int = 100, *, train_views: int = TRAIN_VIEWS, test_views: int = TEST_VIEWS) -> Scene:
    """Computes the scene.

    Args:
        size: of the square images, pixels.
        train_views: spread over the upper hemisphere on a spherical Fibonacci lattice.
        test_views: on an orbit that rises and falls twice, apart from the training views.

    Examples:
        >>> from voronerf.app.scenes import builtin_scene
        >>> scene = builtin_scene(8)
        >>> scene.train.cameras.width, len(scene.train), len(scene.test)
        (8, 100, 25)
    """
    cameras = builtin_cameras("builtin_scene", size, train_views, test_views)
    return render_scene("builtin", cameras, see, bounds(), SUPERSAMPLES)


def render_scene(name: str, cameras: tuple[Cameras, Cameras], see: See, box: Array, supersamples: int) -> Scene:
    """The scene of training and test cameras as `builtin_cameras` gives them; the rest as of `render_views`."""
    train, test = (
        render_views(views, part, see, box=box, supersamples=supersamples)
        for part, views in zip(("train", "test"), cameras)
    )
    return Scene(name, train, test, NEAR, FAR, torch.from_numpy(box), "linear", "white")


def builtin_cameras(caller: str, size: int, train_views: int, test_views: int) -> tuple[Cameras, Cameras]:
    """The cameras of the training and of the test views of a built-in scene.

    Raises:
        ValueError: a size or number of views below 1; names ``caller``.
    """
    if size < 1:
        raise ValueError(f"{caller}: size must be >= 1, got {size}")
    if train_views < 1 or test_views < 1:
        raise ValueError(f"{caller}: there must be at least one view, got {train_views} and {test_views}")
    height = (torch.arange(train_views) + 0.5) / train_views
    golden = math.pi * (3 - math.sqrt(5))
    train = _cameras(torch.asin(0.02 + 0.96 * height), golden * torch.arange(train_views), size)
    turn = 2 * math.pi * torch.arange(test_views) / test_views
    return train, _cameras(torch.deg2rad(28 + 16 * torch.sin(2 * turn)), turn + 0.05, size)


def bounds(solids: Sequence[Solid] = SOLIDS) -> Array:
    """The box that holds all solids, [2, 3]."""
    boxes = np.stack([solid.bounds() for solid in solids])
    return np.stack((boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)))


def cast(origins: Array, directions: Array, caster: Caster | None = None) -> tuple[Array, Array]:
    """First hits of rays, and their light.

    Args:
        origins: [r, 3], or [1, 3] where all rays start from the same point.
        directions: [r, 3], unit.
        caster: of the solids that there are; default: of those of the scene.

    Returns:
        (colour [r, 3] in 0..1, zero where nothing is hit; depth [r], infinite there).
    """
    caster = caster or CASTER
    depth, which = caster(origins, directions)
    rows = np.isfinite(depth).nonzero()[0]
    rows = rows[np.argsort(which[rows], kind="stable")]  # those of a solid lie together
    seen_along = directions[rows]
    points = (origins if len(origins) == 1 else origins[rows]) + depth[rows, None] * seen_along
    normals, albedo = np.zeros_like(points), np.zeros_like(points)
    gloss, sharpness = np.zeros(len(rows), dtype=np.float32), np.ones(len(rows), dtype=np.float32)
    numbers, starts = np.unique(which[rows], return_index=True)
    for number, start, end in zip(numbers, starts, [*starts[1:], len(rows)]):
        solid, mine = caster.solids[number], slice(start, end)
        normals[mine], albedo[mine] = solid.surface(points[mine])
        gloss[mine], sharpness[mine] = solid.gloss, solid.sharpness
    colour = np.zeros_like(directions)
    colour[rows] = _shade(points, normals, albedo, gloss, sharpness, seen_along, caster)
    return colour, depth


def _shade(
    points: Array, normals: Array, albedo: Array, gloss: Array, sharpness: Array, directions: Array, caster: Caster
) -> Array:
    """Sky light from above, one lamp far away with hard shadows, Phong highlights."""
    facing = np.maximum(_dots(normals, LIGHT), 0)
    lit = (facing > 0).nonzero()[0]
    start = points[lit] + np.float32(LIFT) * normals[lit]
    lamp = (facing > 0).astype(np.float32)
    lamp[lit[np.isfinite(caster(start, LIGHT)[0])]] = 0.0
    ambient = AMBIENT_DOWN + (AMBIENT_UP - AMBIENT_DOWN) * (0.5 + 0.5 * normals[:, 2])
    mirrored = 2 * facing[:, None] * normals - LIGHT
    highlight = gloss * np.maximum(-_dots(mirrored, directions), 0) ** sharpness
    light = (ambient + DIFFUSE * facing * lamp)[:, None]
    return np.clip(albedo * light + (highlight * lamp)[:, None], 0, 1).astype(np.float32)


def _dots(first: Array, second: Array) -> Array:
    """Products of vectors [n, 3], [n]: NumPy's sum over three columns takes several times as long."""
    x, y, z = (first * second).T
    return x + y + z


def _cameras(elevation: Tensor, azimuth: Tensor, size: int) -> Cameras:
    around = torch.stack((elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()), dim=-1)
    poses = look_at(DISTANCE * around, torch.zeros(3), torch.tensor((0.0, 0.0, 1.0)))
    focal = 0.5 * size / math.tan(0.5 * ANGLE_X)
    return Cameras(poses, torch.tensor((focal, focal, size / 2, size / 2)).repeat(len(poses), 1), size, size)


def see(origins: Array, directions: Array, caster: Caster | None = None) -> Array:
    """First hits of rays as premultiplied colour and coverage, [r, 4]; arguments are those of `cast`."""
    colour, depth = cast(origins, directions, caster)
    return np.concatenate((colour, np.isfinite(depth)[:, None]), axis=-1, dtype=np.float32)


def render_views(
    cameras: Cameras, name: str, see: See, *, box: Array, supersamples: int, keep: Keep | None = None
) -> Split:
    """All images, on all cores, each with an alpha channel.

    Args:
        cameras: their poses, all with one focal length and the principal point in the middle.
        name: of the split, which its images are named after.
        see: as `see`, premultiplied colour and opacity in 0..1.
        box: [2, 3] that holds everything; ``see`` gets the rays that meet it.
        supersamples: rays on each side of a pixel, which is their average.
        keep: gives the images [c, h, w, 4] of a function that makes one; default: all are made now.
    """

    def make(indices: Sequence[int]) -> NDArray[np.uint8]:
        return _images(cameras, indices, see, box, supersamples)

    count = len(cameras)
    if keep is None:  # small views several at a time, since NumPy's calls take longer than a few rays
        several = max(1, BAND // (cameras.height * cameras.width * supersamples**2))
        several = min(several, -(-count // (os.cpu_count() or 1)))
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            made = pool.map(make, [range(i, min(i + several, count)) for i in range(0, count, several)])
            images = torch.from_numpy(np.concatenate(list(made)))
    else:
        images = keep((count, cameras.height, cameras.width, 4), lambda index: make([index])[0])
    names = tuple(f"{name}_{index:03d}" for index in range(len(cameras)))
    return Split(cameras, images, names)


def _images(cameras: Cameras, indices: Sequence[int], see: See, box: Array, fine: int) -> NDArray[np.uint8]:
    """Some images: fine^2 rays a pixel, a band of rows at a time; averages premultiplied colour and opacity."""
    size = cameras.width
    middle, half = (box[0] + box[1]) / 2, ((box[1] - box[0]) / 2).tolist()
    images = np.zeros((len(indices), size, size, 4), dtype=np.uint8)
    band = max(1, BAND // (size * fine * fine))
    for first in range(0, size, band):
        parts = [_directions(cameras, index, fine, slice(first * fine, (first + band) * fine)) for index in indices]
        directions = np.concatenate(parts)
        origins: Array = cameras.poses[list(indices), :3, 3].numpy()
        if len(indices) > 1:
            origins = np.repeat(origins, len(parts[0]), axis=0)
        enter, leave, _ = slab(tuple((origins - middle).T), tuple(directions.T), half)
        inside = (leave > np.maximum(enter, 0)).nonzero()[0]  # the camera may be in the box
        rgba = np.zeros((len(directions), 4), dtype=np.float32)
        rgba[inside] = see(origins if len(origins) == 1 else origins[inside], directions[inside])
        pixels = rgba.reshape(-1, fine, size, fine, 4).mean(axis=(1, 3))
        pixels[..., :3] /= np.maximum(pixels[..., 3:], np.float32(1e-6))
        shown = np.rint(pixels * 255).clip(0, 255).astype(np.uint8)
        images[:, first : first + band] = shown.reshape(len(indices), -1, size, 4)
    return images


def _directions(cameras: Cameras, index: int, fine: int, rows: slice) -> Array:
    """The rays of some rows of an image, row by row, [r, 3]."""
    size = cameras.width
    pose: Array = cameras.poses[index].numpy()
    focal = float(cameras.intrinsics[index, 0])
    steps = ((np.arange(size * fine, dtype=np.float32) + np.float32(0.5)) / fine - size / 2) / np.float32(focal)
    u, v = np.meshgrid(steps, steps[rows])
    local = np.stack((u.ravel(), -v.ravel(), np.full(u.size, -1, dtype=np.float32)), axis=-1)
    return normalised(turned(local, pose[:3, :3].T))
