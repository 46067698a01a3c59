"""Updating an occupancy grid from rendered samples. x, y, z cells along each axis, m samples."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
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
    found = sigma.nan_to_num(nan=float("inf"), posinf=float("inf"))
    # weight = light that arrives * share of it that is taken
    seen = weights > hidden * -torch.expm1(-found * deltas)
    rows = cells_of(positions, box, density.shape).long()
    flat = density.view(-1)
    # A cell decays once, however often it occurs.
    faded = flat.scatter(0, rows, flat[rows] * decay)
    flat.copy_(faded.scatter_reduce(0, rows, torch.where(seen, found, 0), "amax"))
    occupied.view(-1)[rows] = flat[rows] >= threshold


def observe_told(
    density: Tensor,
    occupied: Tensor,
    box: Tensor,
    told: Tensor,
    reached: Tensor | None,
    samples: tuple[Tensor, Tensor, Tensor, Tensor],
    decay: float,
    threshold: float,
    hidden: float,
) -> None:
    """The same with samples [c, 2] that other ranks have told; see ``voronerf.ops.observe_told``."""
    cells = told[:, 0].contiguous().view(torch.int32)
    if reached is not None:
        ours = reached.view(-1)[cells.long()]
        cells, told = cells[ours], told[ours]
    shape = torch.tensor(density.shape, device=density.device)
    _, y, z = density.shape
    place = torch.stack((cells // (y * z), cells // z % y, cells % z), dim=-1).float() + 0.5
    ones = torch.ones_like(told[:, 1])  # whether it is visible has been decided
    others = torch.lerp(box[0], box[1], place / shape), told[:, 1], ones, ones
    positions, sigma, deltas, weights = (torch.cat(both) for both in zip(samples, others, strict=True))
    observe_occupancy(density, occupied, box, positions, sigma, deltas, weights, decay, threshold, hidden)


def tell_observed(
    density: Tensor, box: Tensor, several: Tensor | None, samples: tuple[Tensor, Tensor, Tensor, Tensor], hidden: float
) -> Tensor:
    """Cell, as bits of float32, and density [c, 2] of samples; see ``voronerf.ops.tell_observed``."""
    positions, sigma, deltas, weights = samples
    cells = cells_of(positions, box, density.shape)
    found = sigma.nan_to_num(nan=float("inf"), posinf=float("inf"))
    found = torch.where(weights > hidden * -torch.expm1(-found * deltas), found, 0)
    told = torch.stack((cells.view(torch.float32), found), 1)
    return told if several is None else told[several.view(-1)[cells.long()]]


def cells_of(points: Tensor, box: Tensor, shape: torch.Size) -> Tensor:
    """Flat numbers int32 [n] of the cells that points [n, 3] lie in; outside the box the nearest at its border."""
    places = (points - box[0]) / (box[1] - box[0])
    x, y, z = ((places[:, i] * size).nan_to_num(0).clamp(0, size - 1).int() for i, size in enumerate(shape))
    return (x * shape[1] + y) * shape[2] + z
