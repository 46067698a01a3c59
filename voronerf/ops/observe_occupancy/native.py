"""``observe_occupancy`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import native

#: Positions, sigma, deltas and weights.
Samples = tuple[Tensor, Tensor, Tensor, Tensor]


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
    given = _samples(density, box, (positions, sigma, deltas, weights), decay, threshold, hidden)
    m = positions.shape[0]
    machine = native.machine(density)
    cells, before = density.new_empty(m, dtype=torch.int32), density.new_empty(m)
    native.compiled.observe_occupancy(given, density, occupied.view(torch.uint8), cells, before, machine)


def observe_told(
    density: Tensor,
    occupied: Tensor,
    box: Tensor,
    told: Tensor,
    reached: Tensor | None,
    samples: Samples,
    decay: float,
    threshold: float,
    hidden: float,
) -> None:
    """The same with samples [c, 2] that other ranks have told, on the CPU; see ``voronerf.ops.observe_told``."""
    given = _samples(density, box, samples, decay, threshold, hidden)
    rows = len(samples[0]) + len(told)
    cells, before = density.new_empty(rows, dtype=torch.int32), density.new_empty(rows)
    reached = torch.ones_like(occupied) if reached is None else reached
    grid = density, occupied.view(torch.uint8), cells, before, native.cpu()
    native.compiled.observe_told(given, told, len(told), reached.view(torch.uint8), *grid)


def tell_observed(density: Tensor, box: Tensor, several: Tensor | None, samples: Samples, hidden: float) -> Tensor:
    """Cell, as bits of float32, and density [c, 2] of samples, on the CPU; see ``voronerf.ops.tell_observed``."""
    told = density.new_empty(len(samples[0]), 2)
    given = _samples(density, box, samples, 1.0, 1.0, hidden)
    several = None if several is None else several.view(torch.uint8)
    return told[: native.compiled.tell_observed(given, several, told, native.cpu())]


def _samples(
    density: Tensor, box: Tensor, samples: Samples, decay: float, threshold: float, hidden: float
) -> native.compiled.ObservedSamples:
    positions, sigma, deltas, weights = samples
    x, y, z = density.shape
    return native.compiled.ObservedSamples(
        positions=positions,
        sigma=sigma,
        deltas=deltas,
        weights=weights,
        box=box,
        x=x,
        y=y,
        z=z,
        m=positions.shape[0],
        decay=decay,
        threshold=threshold,
        hidden=hidden,
    )
