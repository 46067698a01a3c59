"""``march_rays`` of the compiled module. r rays, s strata of a ray, m samples of all rays (packed).

Two passes, since the number of samples is known between them: the first leaves a bit for every stratum that is kept and
the offsets of the rays, the second the samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.checks import MAX_COUNT
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops.march_rays.reference import Rays

Marched = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _results(near: Tensor, offsets: Tensor, rows: int) -> Marched:
    """Memory for the samples of a `March`, after the offsets of the rays."""
    ray_index, stop = (near.new_empty(count, dtype=torch.int32) for count in (rows, near.shape[0]))
    return offsets, ray_index, near.new_empty(rows), near.new_empty(rows), near.new_empty(rows, 3), stop


def _shapes(*given: Any) -> Marched:
    """Without a capacity the number of samples depends on where the rays go."""
    *rays, capacity = given
    near = Rays._make(rays).near
    rows: Any = torch.library.get_ctx().new_dynamic_size() if capacity is None else capacity
    return _results(near, near.new_empty(near.shape[0] + 1, dtype=torch.int32), rows)


@custom_op("march_rays_native", fake=_shapes)
def march_rays(rays: Rays, capacity: int | None) -> Iterator[Marched]:
    """One sample for each stratum that falls in an occupied cell; see ``voronerf.ops.march_rays``."""
    inputs, machine, (r,) = inputs_of(rays), native.machine(rays.near), rays.near.shape
    mask = rays.near.new_empty(r, -(-rays.samples // 32), dtype=torch.int32)
    offsets = rays.near.new_empty(r + 1, dtype=torch.int32)
    most = MAX_COUNT if capacity is None else capacity
    native.compiled.march_rays_count(inputs, mask, offsets, most, machine)
    rows = int(offsets[-1]) if capacity is None else capacity
    results = _results(rays.near, offsets, rows)
    yield results
    native.compiled.march_rays_fill(inputs, mask, offsets, rows, *results[1:], machine)


def inputs_of(rays: Rays) -> native.compiled.MarchInputs:
    """What compiled functions read of rays."""
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
