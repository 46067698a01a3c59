"""The first of some solids on rays, on the CPU. No custom op: nothing that is traced or differentiated casts rays."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.first_solid.reference import Solids


def first_solid(origins: Tensor, directions: Tensor, solids: Solids) -> tuple[Tensor, Tensor]:
    """Distances [r] and numbers [r]; see ``voronerf.ops.first_solid``."""
    count = directions.shape[0] if origins.shape[0] == 1 else origins.shape[0]
    depth = origins.new_empty(count)
    number = torch.empty(count, dtype=torch.int32)
    given = native.compiled.SolidsOnRays(
        origins=origins,
        directions=directions,
        r=count,
        one_origin=origins.shape[0] == 1,
        one_direction=directions.shape[0] == 1,
        **solids._asdict(),
        m=solids.kinds.shape[0],
    )
    native.compiled.first_solid(given, depth, number, native.cpu())
    return depth, number
