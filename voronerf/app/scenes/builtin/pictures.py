"""Renders and shades pictures of solids. All pictures are square and have an alpha channel."""

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

SUPERSAMPLES = 3  # samples along each side of a pixel, in images up to `LARGE`
LARGE = 200  # width in pixels; wider images use two samples along each side of a pixel
LIGHT = normalised(np.array(((0.45, -0.55, 0.70),), dtype=np.float32))[0]
AMBIENT_DOWN, AMBIENT_UP, DIFFUSE = 0.46, 0.64, 0.50
LIFT = 2e-3  # distance of a shadow ray's origin from the surface
BAND = 1 << 16  # rays per chunk; its arrays fit in the cache
BOXES = 1 << 13  # maximum number of bounding boxes projected per chunk

# (shape [c, h, w, 4], function that computes image i) -> images
Keep = Callable[[tuple[int, int, int, int], Make], Tensor]


def bounds(solids: Sequence[Solid]) -> Array:
    """Returns the bounding box of all solids, [2, 3]."""
    boxes = np.stack([solid.bounds() for solid in solids])
    return np.stack((boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)))


def keep_in_store(name: str, sources: Sequence[Any], formula: int, images: str) -> Keep | None:
    """Returns a function that stores images in the cache directory, or None if `images` is "memory".

    For "disk" the function returns the memory-mapped images, for "cached" a copy in memory.

    Args:
        name: name of the scene and split, with which the store's folder begins.
        sources: numbers that determine the images, such as their size; different lists have different stores.
        formula: version of the scene's content; a change computes the images anew.
        images: "memory", "cached" or "disk".
    """

    def keep(shape: tuple[int, int, int, int], make: Make) -> Tensor:
        computed = stored(name, sources, formula, shape, make, os.cpu_count() or 1)
        return computed if images == "disk" else computed.clone()

    return None if images == "memory" else keep


def render_views(cameras: Cameras, name: str, caster: Caster, keep: Keep | None = None) -> Split:
    """Renders the images of all cameras on all cores.

    Args:
        cameras: the cameras, with equal focal lengths in x and y and the principal point at the centre.
        name: name of the split; the images' names begin with it.
        caster: ray caster with the solids.
        keep: function that returns stored images [c, h, w, 4] and computes missing ones; by default, none are stored.
    """
    count, size = len(cameras), cameras.width
    if keep is None:  # batches small views to amortise the overhead of NumPy calls
        limit = min(BAND // (size * SUPERSAMPLES) ** 2, BOXES // len(caster.solids), -(-count // (os.cpu_count() or 1)))
        group_size = max(1, limit)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            groups = [range(i, min(i + group_size, count)) for i in range(0, count, group_size)]
            batches = pool.map(lambda indices: _images(cameras, indices, caster), groups)
            images = torch.from_numpy(np.concatenate(list(batches)))
    else:
        images = keep((count, size, size, 4), lambda index: _images(cameras, [index], caster)[0])
    return Split(cameras, images, tuple(f"{name}_{index:03d}" for index in range(count)))


def _images(cameras: Cameras, indices: Sequence[int], caster: Caster) -> NDArray[np.uint8]:
    """Renders the images `indices` in bands of rows; the images have straight alpha.

    A pixel's opacity is the mean over its rays; its colour is their mean premultiplied colour, divided by this opacity.
    """
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
    """Returns the colours [r, 3] of the ray hits, in 0..1; zero for a miss.

    The light is ambient sky light, strongest from above, and a distant lamp with hard shadows and Phong highlights.

    Args:
        origins: ray origins [r, 3].
        directions: unit ray directions [r, 3].
        depth: distance to the hit [r], infinite for a miss.
        number: number of the hit solid [r].
        caster: ray caster with the solids.
    """
    rows = np.isfinite(depth).nonzero()[0]
    rows = rows[np.argsort(number[rows], kind="stable")]  # groups the hits by solid
    along = directions[rows]
    points = origins[rows] + depth[rows, None] * along
    normals, albedo = np.zeros_like(points), np.zeros_like(points)
    gloss, sharpness = np.zeros(len(rows), dtype=np.float32), np.ones(len(rows), dtype=np.float32)
    numbers, starts = np.unique(number[rows], return_index=True)
    for index, start, end in zip(numbers, starts, [*starts[1:], len(rows)]):
        solid, selected = caster.solids[index], slice(start, end)
        normals[selected], albedo[selected] = solid.surface(points[selected])
        gloss[selected], sharpness[selected] = solid.gloss, solid.sharpness
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
    """Returns the dot products [n] of vectors [n, 3]; several times faster than NumPy's sum over three columns."""
    x, y, z = (first * second).T
    return x + y + z
