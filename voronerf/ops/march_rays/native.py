"""``march_rays`` of the compiled module. r rays, s strata of a ray, m samples of all rays (packed).

Two custom ops, since the number of samples is known between them: the first leaves a bit for every stratum that is kept
and the offsets of the rays, the second the samples.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf import native
from voronerf.checks import MAX_COUNT
from voronerf.custom_op import custom_op
from voronerf.ops.march_rays.reference import March, Rays


def march_rays(rays: Rays, capacity: int | None) -> March:
    """One sample for each stratum that falls in an occupied cell; see ``voronerf.ops.march_rays``."""
    mask, offsets = _count(rays, MAX_COUNT if capacity is None else capacity)
    rows = int(offsets[-1]) if capacity is None else capacity
    return March(offsets, *_fill(rays, mask, offsets, rows))


@custom_op("march_rays_native_count")
def _count(rays: Rays, capacity: int) -> Iterator[tuple[Tensor, Tensor]]:
    r = rays.near.shape[0]
    mask = rays.near.new_empty(r, -(-rays.samples // 32), dtype=torch.int32)
    offsets = rays.near.new_empty(r + 1, dtype=torch.int32)
    yield mask, offsets
    native.compiled.march_rays_count(_inputs(rays), mask, offsets, capacity, native.machine(rays.near))


@custom_op("march_rays_native_fill")
def _fill(
    rays: Rays, mask: Tensor, offsets: Tensor, rows: int
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    near = rays.near
    ray_index, stop = (near.new_empty(count, dtype=torch.int32) for count in (rows, near.shape[0]))
    depths, deltas, positions = near.new_empty(rows), near.new_empty(rows), near.new_empty(rows, 3)
    results = ray_index, depths, deltas, positions, stop
    yield results
    native.compiled.march_rays_fill(_inputs(rays), mask, offsets, rows, *results, native.machine(near))


def _inputs(rays: Rays) -> native.compiled.MarchInputs:
    x, y, z = rays.occupied.shape
    contraction = rays.contraction
    contracted = 0 if contraction is None else contraction.dim()
    return native.compiled.MarchInputs(
        origins=rays.origins,
        directions=rays.directions,
        near=rays.near,
        far=rays.far,
        occupied=rays.occupied.view(torch.uint8),
        box=rays.box,
        uniforms=rays.uniforms,
        seed=rays.seed,
        start=rays.start,
        r=rays.near.shape[0],
        s=rays.samples,
        x=x,
        y=y,
        z=z,
        disparity=rays.disparity,
        most=rays.most,
        space=native.compiled.MarchSpace(
            sphere=contraction if contracted == 1 else None, perspective=contraction if contracted == 2 else None
        ),
    )
