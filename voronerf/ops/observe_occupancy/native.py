"""``observe_occupancy`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

import torch

from voronerf.ops._core import native
from voronerf.ops.observe_occupancy.reference import Observed


def observe_occupancy(given: Observed) -> None:
    """Fades and raises the cells of the samples; see ``voronerf.ops.observe_occupancy``."""
    density, m, (x, y, z) = given.density, len(given.positions), given.density.shape
    samples = native.compiled.ObservedSamples(
        positions=given.positions,
        sigma=given.sigma,
        deltas=given.deltas,
        weights=given.weights,
        box=given.box,
        x=x,
        y=y,
        z=z,
        m=m,
        decay=given.decay,
        threshold=given.threshold,
        hidden=given.hidden,
    )
    memory = density.new_empty(m, dtype=torch.int32), density.new_empty(m)  # cells, and the densities that these had
    occupied = given.occupied.view(torch.uint8)
    native.compiled.observe_occupancy(samples, density, occupied, *memory, native.machine(density))
