"""``observe_occupancy`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

from typing import Any

import torch

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops.march_rays.native import space_of

_OP = declared("observe_occupancy")
_samples = _OP.inputs(
    native.compiled.ObservedSamples, fixed="None if fixed is None else fixed.view(torch.uint8)", space=space_of
)


@_OP.plain
def observe_occupancy(given: Any) -> None:
    """Fades and raises the cells of the samples; see ``voronerf.ops.observe_occupancy``."""
    density, occupied, m = given.density, given.occupied.view(torch.uint8), given.m
    memory = density.new_empty(m, dtype=torch.int32), density.new_empty(m)  # cells, and the densities that these had
    native.compiled.observe_occupancy(_samples(given), density, occupied, *memory, native.machine(density))
