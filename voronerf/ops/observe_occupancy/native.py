"""``observe_occupancy`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import native
from voronerf.ops.observe_occupancy.reference import Observed


def observe_occupancy(given: Observed) -> None:
    """Fades and raises the cells of the samples; see ``voronerf.ops.observe_occupancy``."""
    native.compiled.observe_occupancy(
        _samples(given), *_grid(given, len(given.positions)), native.machine(given.density)
    )


def observe_told(given: Observed, told: Tensor, reached: Tensor | None) -> None:
    """The same with samples [c, 2] that other ranks have told, on the CPU; see ``voronerf.ops.observe_told``."""
    reached = (torch.ones_like(given.occupied) if reached is None else reached).view(torch.uint8)
    grid = _grid(given, len(given.positions) + len(told))
    native.compiled.observe_told(_samples(given), told, len(told), reached, *grid, native.cpu())


def tell_observed(given: Observed, several: Tensor | None) -> Tensor:
    """Cell, as bits of float32, and density [c, 2] of samples, on the CPU; see ``voronerf.ops.tell_observed``."""
    told = given.density.new_empty(len(given.positions), 2)
    several = None if several is None else several.view(torch.uint8)
    return told[: native.compiled.tell_observed(_samples(given), several, told, native.cpu())]


def _grid(given: Observed, rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Density, occupied, and memory for the cells of rows and the densities that these had."""
    density = given.density
    return (
        density,
        given.occupied.view(torch.uint8),
        density.new_empty(rows, dtype=torch.int32),
        density.new_empty(rows),
    )


def _samples(given: Observed) -> native.compiled.ObservedSamples:
    x, y, z = given.density.shape
    return native.compiled.ObservedSamples(
        positions=given.positions,
        sigma=given.sigma,
        deltas=given.deltas,
        weights=given.weights,
        box=given.box,
        x=x,
        y=y,
        z=z,
        m=len(given.positions),
        decay=given.decay,
        threshold=given.threshold,
        hidden=given.hidden,
    )
