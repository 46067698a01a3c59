"""``march_rays`` of the compiled module. r rays, s strata of a ray, m samples of all rays (packed).

Two passes, since the number of samples is known between them: the first leaves a bit for every stratum that is kept and
the offsets of the rays, the second the samples.
"""

from __future__ import annotations

from typing import Any

import torch

from voronerf.ops._core import native
from voronerf.ops._core.checks import MAX_COUNT
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty, read_count
from voronerf.ops.march_rays.reference import March, fake, memory


def space_of(given: Any) -> native.compiled.MarchSpace:
    """The space of a grid, from the ``contraction`` of an op."""
    contracted = 0 if given.contraction is None else given.contraction.dim()
    return native.compiled.MarchSpace(
        sphere=given.contraction if contracted == 1 else None,
        perspective=given.contraction if contracted == 2 else None,
    )


_OP = declared("march_rays")
INPUTS: dict[str, Any] = {
    "s": "samples",
    "most": lambda given: given.samples if given.most is None else given.most,
    "space": space_of,
}
"""Members of the struct that are no arguments."""
inputs_of = _OP.inputs(native.compiled.MarchInputs, **INPUTS)


@_OP.custom_op("march_rays_native", fake=fake)
def march_rays(given: Any) -> March:
    """Samples in occupied cells; see ``voronerf.ops.march_rays``."""
    near, capacity, inputs, machine = given.near, given.capacity, inputs_of(given), native.machine(given.near)
    mask = new_empty(near, given.r, -(-given.samples // 32), dtype=torch.int32)
    offsets = new_empty(near, given.r + 1, dtype=torch.int32)
    most, total = MAX_COUNT if capacity is None else capacity, near.new_empty(1, dtype=torch.int64)
    if isinstance(machine, native.compiled.Cuda):
        native.compiled.march_rays_count(inputs, mask, offsets, most, machine)
        total = offsets[-1:]
    else:
        native.compiled.march_rays_count(inputs, mask, offsets, total, most, machine)
    rows = read_count(total) if capacity is None else capacity
    found = memory(near, offsets, rows)
    native.compiled.march_rays_fill(inputs, mask, offsets, rows, *found[1:], machine)
    return found
