"""``march_rays`` of the compiled module. r rays, s strata of a ray, m samples of all rays (packed).

The first of two passes writes a bit for every stratum that is kept, and the offsets of the rays. The number of samples
is then known, and the second pass writes the samples.
"""

from __future__ import annotations

from typing import Any

import torch

from voronerf.ops._core import native
from voronerf.ops._core.checks import MAX_COUNT
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty, read_count
from voronerf.ops.march_rays.reference import March, fake, memory


def space_of(arguments: Any) -> native.compiled.MarchSpace:
    """Returns the struct of the grid's space, from the argument ``contraction`` of an op."""
    contracted = 0 if arguments.contraction is None else arguments.contraction.dim()
    return native.compiled.MarchSpace(
        sphere=arguments.contraction if contracted == 1 else None,
        perspective=arguments.contraction if contracted == 2 else None,
    )


_OP = declared("march_rays")
INPUTS: dict[str, Any] = {
    "s": "samples",
    "max_samples": lambda arguments: arguments.samples if arguments.max_samples is None else arguments.max_samples,
    "space": space_of,
}
"""The sources of members of ``MarchInputs``; any other member is the argument of the same name. A source is the name of
an argument, or a function that computes the member from the arguments."""
inputs_of = _OP.inputs(native.compiled.MarchInputs, **INPUTS)


@_OP.custom_op("march_rays_native", fake=fake)
def march_rays(arguments: Any) -> March:
    """Samples the strata in occupied voxels; see ``voronerf.ops.march_rays``."""
    near, capacity, inputs, machine = (
        arguments.near,
        arguments.capacity,
        inputs_of(arguments),
        native.machine(arguments.near),
    )
    mask = new_empty(near, arguments.r, -(-arguments.samples // 32), dtype=torch.int32)
    offsets = new_empty(near, arguments.r + 1, dtype=torch.int32)
    most, total = MAX_COUNT if capacity is None else capacity, near.new_empty(1, dtype=torch.int64)
    if isinstance(machine, native.compiled.Cuda):
        native.compiled.march_rays_count(inputs, mask, offsets, most, machine)
        total = offsets[-1:]
    else:
        native.compiled.march_rays_count(inputs, mask, offsets, total, most, machine)
    rows = read_count(total) if capacity is None else capacity
    march = memory(near, offsets, rows)
    native.compiled.march_rays_fill(inputs, mask, offsets, rows, *march[1:], machine)
    return march
