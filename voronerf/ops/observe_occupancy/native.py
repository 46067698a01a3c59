"""``observe_occupancy`` of the compiled module."""

from __future__ import annotations

from typing import Any

import torch

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty
from voronerf.ops.march_rays.native import space_of

_OP = declared("observe_occupancy")
_samples = _OP.inputs(
    native.compiled.ObservedSamples,
    fixed=lambda given: None if given.fixed is None else given.fixed.view(torch.uint8),
    space=space_of,
)


@_OP.custom_op("observe_occupancy_native")
def observe_occupancy(given: Any, _: None) -> None:
    """Fades and raises the cells of the samples; see ``voronerf.ops.observe_occupancy``."""
    density, occupied, m = given.density, given.occupied.view(torch.uint8), given.m
    memory = new_empty(density, m, dtype=torch.int32), new_empty(density, m)  # cells, and the densities that these had
    native.compiled.observe_occupancy(_samples(given), density, occupied, *memory, native.machine(density))
