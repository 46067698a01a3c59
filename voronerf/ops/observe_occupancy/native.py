"""``observe_occupancy`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import native


def observe_occupancy(
    density: Tensor,
    occupied: Tensor,
    box: Tensor,
    positions: Tensor,
    sigma: Tensor,
    deltas: Tensor,
    weights: Tensor,
    decay: float,
    threshold: float,
    hidden: float,
) -> None:
    """Fades and raises the cells of the samples; see ``voronerf.ops.observe_occupancy``."""
    m, (x, y, z) = positions.shape[0], density.shape
    given = native.compiled.ObservedSamples(
        positions=positions,
        sigma=sigma,
        deltas=deltas,
        weights=weights,
        box=box,
        x=x,
        y=y,
        z=z,
        m=m,
        decay=decay,
        threshold=threshold,
        hidden=hidden,
    )
    machine = native.machine(density)
    cells, before = density.new_empty(m, dtype=torch.int32), density.new_empty(m)
    native.compiled.observe_occupancy(given, density, occupied.view(torch.uint8), cells, before, machine)
