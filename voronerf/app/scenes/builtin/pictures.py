"""Pictures of solids and their light. All views are square, with an alpha channel."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.solids import Array, Solid, normalised, turned
from voronerf.app.scenes.scene import Split
from voronerf.app.scenes.store import Make, stored
from voronerf.nerf.cameras import Cameras

SUPERSAMPLES = 3  # on each side of a pixel
LARGE = 200  # pixels a side, above which two are enough
LIGHT = normalised(np.array(((0.45, -0.55, 0.70),), dtype=np.float32))[0]
AMBIENT_DOWN, AMBIENT_UP, DIFFUSE = 0.46, 0.64, 0.50
LIFT = 2e-3  # a shadow's ray starts this far above the surface
BAND = 1 << 16  # rays at a time, so that their arrays stay in the cache
BOXES = 1 << 13  # of solids that are projected at a time

# from a shape [c, h, w, 4] and a function that makes image i to the images
Keep = Callable[[tuple[int, int, int, int], Make], Tensor]


def bounds(solids: Sequence[Solid]) -> Array:
    """The box that holds all solids, [2, 3]."""
    boxes = np.stack([solid.bounds() for solid in solids])
    return np.stack((boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)))


def keep_in_store(name: str, sources: Sequence[Any], formula: int, images: str) -> Keep | None:
    """What keeps images in a store of the cache, and for "cached" copies them into memory; None for "memory"."""

    def keep(shape: tuple[int, int, int, int], make: Make) -> Tensor:
        computed = stored(name, sources, formula, shape, make, os.cpu_count() or 1)
        return computed if images == "disk" else computed.clone()

    return None if images == "memory" else keep


def render_views(cameras: Cameras, name: str, caster: Caster, keep: Keep | None = None) -> Split:
    """All images, on all cores.

    Args:
        cameras: with one focal length each and the principal point in the middle.
        name: of the split, which its images are named after.
        caster: of the solids.
        keep: gives the images [c, h, w, 4] of a function that makes one; default: all are made now.
    """
    count, size = len(cameras), cameras.width
    if keep is None:  # small views several at a time, since NumPy's calls take longer than a few rays
        most = min(BAND // (size * SUPERSAMPLES) ** 2, BOXES // len(caster.solids), -(-count // (os.cpu_count() or 1)))
        several = max(1, most)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            groups = [range(i, min(i + several, count)) for i in range(0, count, several)]
            made = pool.map(lambda indices: _images(cameras, indices, caster), groups)
            images = torch.from_numpy(np.concatenate(list(made)))
    else:
        images = keep((count, size, size, 4), lambda index: _images(cameras, [index], caster)[0])
    return Split(cameras, images, tuple(f"{name}_{index:03d}" for index in range(count)))


def _images(cameras: Cameras, indices: Sequence[int], caster: Caster) -> NDArray[np.uint8]:
    """Some images, a band of rows at a time; pixels are averages of premultiplied colour and opacity."""
    size = cameras.width
    fine = SUPERSAMPLES if size <= LARGE else 2
    images = np.zeros((len(indices), size, size, 4), dtype=np.uint8)
    poses: Array = cameras.poses[list(indices)].numpy()
    focal: Array = cameras.intrinsics[list(indices), 0].numpy()
    places = (np.arange(size * fine, dtype=np.float32) + np.float32(0.5)) / fine - size / 2
    band = max(1, BAND // (size * fine * fine))
    for first in range(0, size, band):
        rows = places[first * fine : (first + band) * fine]
        steps = [np.meshgrid(places / f, rows / f) for f in focal]
        u, v = (np.stack([step[axis] for step in steps]).reshape(len(indices), -1) for axis in (0, 1))
        turns = poses[:, :3, :3].transpose(2, 1, 0)[..., None]
        directions = normalised(np.stack(turned((u, -v, np.full_like(u, -1)), turns), axis=-1).reshape(-1, 3))
        origins = np.repeat(poses[:, :3, 3], u.shape[1], axis=0)
        middle = (size * fine - 1) / 2
        scale = np.stack(
            (focal * fine, np.full_like(focal, middle), np.full_like(focal, middle - first * fine)), axis=1
        )
        depth, number = caster.seen(
            poses.astype(np.float64), scale.astype(np.float64), (len(places), len(rows)), origins.T, directions.T
        )
        rgba = np.zeros((len(depth), 4), dtype=np.float32)
        rgba[:, 3] = np.isfinite(depth)
        rgba[:, :3] = shaded(origins, directions, depth, number, caster)
        pixels = rgba.reshape(-1, fine, size, fine, 4).mean(axis=(1, 3))
        pixels[..., :3] /= np.maximum(pixels[..., 3:], np.float32(1e-6))
        shown = np.rint(pixels * 255).clip(0, 255).astype(np.uint8)
        images[:, first : first + band] = shown.reshape(len(indices), -1, size, 4)
    return images


def shaded(origins: Array, directions: Array, depth: Array, number: NDArray[np.int64], caster: Caster) -> Array:
    """Colours [r, 3] in 0..1 of what rays meet, zero for a miss.

    Sky light from above, one lamp far away with hard shadows, Phong highlights.

    Args:
        origins: [r, 3].
        directions: [r, 3] unit.
        depth: [r], infinite for a miss.
        number: of the solid [r].
        caster: that found them.
    """
    rows = np.isfinite(depth).nonzero()[0]
    rows = rows[np.argsort(number[rows], kind="stable")]  # those of a solid lie together
    along = directions[rows]
    points = origins[rows] + depth[rows, None] * along
    normals, albedo = np.zeros_like(points), np.zeros_like(points)
    gloss, sharpness = np.zeros(len(rows), dtype=np.float32), np.ones(len(rows), dtype=np.float32)
    numbers, starts = np.unique(number[rows], return_index=True)
    for each, start, end in zip(numbers, starts, [*starts[1:], len(rows)]):
        solid, mine = caster.solids[each], slice(start, end)
        normals[mine], albedo[mine] = solid.surface(points[mine])
        gloss[mine], sharpness[mine] = solid.gloss, solid.sharpness
    facing = np.maximum(_dots(normals, LIGHT), 0)
    towards = (facing > 0).nonzero()[0]
    lamp = np.zeros(len(rows), dtype=np.float32)
    lamp[towards] = caster.is_lit((points[towards] + np.float32(LIFT) * normals[towards]).T)
    ambient = AMBIENT_DOWN + (AMBIENT_UP - AMBIENT_DOWN) * (0.5 + 0.5 * normals[:, 2])
    mirrored = 2 * facing[:, None] * normals - LIGHT
    highlight = gloss * np.maximum(-_dots(mirrored, along), 0) ** sharpness
    light = (ambient + DIFFUSE * facing * lamp)[:, None]
    colour = np.zeros_like(directions)
    colour[rows] = np.clip(albedo * light + (highlight * lamp)[:, None], 0, 1)
    return colour


def _dots(first: Array, second: Array) -> Array:
    """Products of vectors [n, 3], [n]: NumPy's sum over three columns takes several times as long."""
    x, y, z = (first * second).T
    return x + y + z
