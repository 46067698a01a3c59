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
from voronerf.native.custom_op import custom_op
from voronerf.ops.march_rays.reference import March


def march_rays(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    samples: int,
    *,
    uniforms: Tensor | None = None,
    seed: Tensor | None = None,
    disparity: bool = False,
    start: Tensor | None = None,
    most: int | None = None,
    capacity: int | None = None,
    contraction: Tensor | None = None,
) -> March:
    """One sample for each stratum that falls in an occupied cell; see ``voronerf.ops.march_rays``."""
    rest = (samples, disparity, samples if most is None else most)
    tensors = (origins, directions, near, far, occupied, box, uniforms, seed, start, contraction)
    mask, offsets = _count(*tensors, *rest, MAX_COUNT if capacity is None else capacity)
    rows = int(offsets[-1]) if capacity is None else capacity
    return March(offsets, *_fill(*tensors, mask, offsets, *rest, rows))


@custom_op("march_rays_native_count")
def _count(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    uniforms: Tensor | None,
    seed: Tensor | None,
    start: Tensor | None,
    contraction: Tensor | None,
    samples: int,
    disparity: bool,
    most: int,
    capacity: int,
) -> Iterator[tuple[Tensor, Tensor]]:
    r = near.shape[0]
    mask = near.new_empty(r, -(-samples // 32), dtype=torch.int32)
    offsets = near.new_empty(r + 1, dtype=torch.int32)
    yield mask, offsets
    given = _inputs(
        origins, directions, near, far, occupied, box, uniforms, seed, start, contraction, samples, disparity, most
    )
    native.compiled.march_rays_count(given, mask, offsets, capacity, native.machine(near))


@custom_op("march_rays_native_fill")
def _fill(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    uniforms: Tensor | None,
    seed: Tensor | None,
    start: Tensor | None,
    contraction: Tensor | None,
    mask: Tensor,
    offsets: Tensor,
    samples: int,
    disparity: bool,
    most: int,
    rows: int,
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    ray_index, stop = (near.new_empty(count, dtype=torch.int32) for count in (rows, near.shape[0]))
    depths, deltas, positions = near.new_empty(rows), near.new_empty(rows), near.new_empty(rows, 3)
    results = ray_index, depths, deltas, positions, stop
    yield results
    given = _inputs(
        origins, directions, near, far, occupied, box, uniforms, seed, start, contraction, samples, disparity, most
    )
    native.compiled.march_rays_fill(given, mask, offsets, rows, *results, native.machine(near))


def _inputs(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    uniforms: Tensor | None,
    seed: Tensor | None,
    start: Tensor | None,
    contraction: Tensor | None,
    samples: int,
    disparity: bool,
    most: int,
) -> native.compiled.MarchInputs:
    x, y, z = occupied.shape
    contracted = 0 if contraction is None else contraction.dim()
    return native.compiled.MarchInputs(
        origins=origins,
        directions=directions,
        near=near,
        far=far,
        occupied=occupied.view(torch.uint8),
        box=box,
        uniforms=uniforms,
        seed=seed,
        start=start,
        r=near.shape[0],
        s=samples,
        x=x,
        y=y,
        z=z,
        disparity=disparity,
        most=most,
        space=native.compiled.MarchSpace(
            sphere=contraction if contracted == 1 else None, perspective=contraction if contracted == 2 else None
        ),
    )
