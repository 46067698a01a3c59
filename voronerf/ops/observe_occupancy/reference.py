"""Updating an occupancy grid from rendered samples. x, y, z cells along each axis, m samples."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Observed(NamedTuple):
    """A grid, samples in it, and what they count; see ``voronerf.ops.observe_occupancy``."""

    density: Tensor
    occupied: Tensor
    box: Tensor
    positions: Tensor
    sigma: Tensor
    deltas: Tensor
    weights: Tensor
    decay: float
    threshold: float
    hidden: float


@torch.no_grad()
def observe_occupancy(given: Observed) -> None:
    """Fades and raises the cells of the samples; see ``voronerf.ops.observe_occupancy``."""
    rows, found = _found(given)
    count = given.density.numel()
    rows = torch.where(given.deltas != 0, rows, count)  # one cell more, for samples that say nothing
    density, occupied = (torch.nn.functional.pad(table.view(-1), (0, 1)) for table in (given.density, given.occupied))
    # A cell decays once, however often it occurs.
    faded = density.scatter(0, rows, density[rows] * given.decay)
    raised = faded.scatter_reduce(0, rows, found, "amax")
    occupied[rows] = raised[rows] >= given.threshold
    given.density.view(-1).copy_(raised[:count])
    given.occupied.view(-1).copy_(occupied[:count])


def observe_told(given: Observed, told: Tensor, reached: Tensor | None) -> None:
    """The same with samples [c, 2] that other ranks have told; see ``voronerf.ops.observe_told``."""
    cells = told[:, 0].contiguous().view(torch.int32)
    if reached is not None:
        ours = reached.view(-1)[cells.long()]
        cells, told = cells[ours], told[ours]
    box, shape = given.box, torch.tensor(given.density.shape, device=told.device)
    _, y, z = given.density.shape
    place = torch.stack((cells // (y * z), cells // z % y, cells % z), dim=-1).float() + 0.5
    ones = torch.ones_like(told[:, 1])  # whether it is visible has been decided
    others = {
        "positions": torch.lerp(box[0], box[1], place / shape),
        "sigma": told[:, 1],
        "deltas": ones,
        "weights": ones,
    }
    both = {name: torch.cat((getattr(given, name), more)) for name, more in others.items()}
    observe_occupancy(given._replace(**both))  # type: ignore[arg-type]


def tell_observed(given: Observed, several: Tensor | None) -> Tensor:
    """Cell, as bits of float32, and density [c, 2] of samples; see ``voronerf.ops.tell_observed``."""
    rows, found = _found(given)
    told = torch.stack((rows.int().view(torch.float32), found), 1)
    kept = given.deltas != 0
    return told[kept if several is None else kept & several.view(-1)[rows]]


def _found(given: Observed) -> tuple[Tensor, Tensor]:
    """The cell of each sample, and its density, 0 where it is hidden."""
    found = given.sigma.nan_to_num(nan=float("inf"), posinf=float("inf"))
    # weight = light that arrives * share of it that is taken
    seen = given.weights > given.hidden * -torch.expm1(-found * given.deltas)
    return cells_of(given.positions, given.box, given.density.shape).long(), torch.where(seen, found, 0)


def cells_of(points: Tensor, box: Tensor, shape: torch.Size) -> Tensor:
    """Flat numbers int32 [n] of the cells that points [n, 3] lie in; outside the box the nearest at its border."""
    places = (points - box[0]) / (box[1] - box[0])
    x, y, z = ((places[:, i] * size).nan_to_num(0).clamp(0, size - 1).int() for i, size in enumerate(shape))
    return (x * shape[1] + y) * shape[2] + z
