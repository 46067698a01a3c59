"""What the samples of all ranks say of an occupancy grid: each rank has its own, of the voxels that its cells reach.

m own samples, v voxels, c voxels that are told.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.distributed.renderer import Learnt
from voronerf.rendering.occupancy import HIDDEN, OccupancyGrid


@torch.no_grad()
def observations(grid: OccupancyGrid, found: Learnt, several: Tensor | None) -> Tensor:
    """What other ranks should know of own samples: voxel, as bits of float32, and density [c, 2].

    Args:
        grid: Of this rank.
        found: By this rank.
        several: bool [v], the voxels that several ranks reach, whose samples are told; None for all.
    """
    positions, density, deltas, weights = found.positions, found.density.float(), found.deltas, found.weights
    if _natively(grid):
        from voronerf.ops.observe_occupancy.native import tell_observed  # which is there where the compiled module is

        return tell_observed(grid.density, grid.box, several, (positions, density, deltas, weights), hidden=HIDDEN)
    cells = grid.cells(positions)
    if several is not None:
        rows = several[cells].nonzero()[:, 0]
        every = cells, positions, density, deltas, weights
        cells, positions, density, deltas, weights = (values[rows] for values in every)
    density = density.nan_to_num(nan=float("inf"), posinf=float("inf"))
    density = torch.where(weights > HIDDEN * -torch.expm1(-density * deltas), density, 0)
    if grid.contraction is not None:  # the grid will stretch them as at the middle of their voxel
        middle = grid.contraction.stretch(grid.points(cells.long()))
        density = density * grid.contraction.stretch(positions) / middle
    return torch.stack((cells.view(torch.float32), density), 1)


def observe(
    grid: OccupancyGrid, found: Learnt, others: Tensor, reached: Tensor | None, *, decay: float, backend: str
) -> None:
    """Teaches a grid what all ranks found.

    Args:
        grid: Of this rank.
        found: By this rank.
        others: [c, 2], the :func:`observations` of all other ranks.
        reached: bool [v], the voxels that own cells reach: others stay as they are; None for all.
        decay: As of a grid.
        backend: As of a grid.
    """
    own = found.positions, found.density.float(), found.deltas, found.weights
    if _natively(grid) and backend in ("auto", "native"):
        from voronerf.ops.observe_occupancy.native import observe_told

        rule = {"decay": decay, "threshold": grid.threshold, "hidden": HIDDEN}
        observe_told(grid.density, grid.occupied, grid.box, others, reached, own, **rule)
        return
    cells = others[:, 0].contiguous().view(torch.int32)
    if reached is not None:
        ours = reached[cells]
        cells, others = cells[ours], others[ours]
    told, ones = others[:, 1], torch.ones_like(others[:, 1])  # whether it is visible has been decided
    every = zip(own, (grid.points(cells.long()), told, ones, ones), strict=True)
    grid.observe(*(torch.cat(both) for both in every), decay=decay, backend=backend)


def _natively(grid: OccupancyGrid) -> bool:
    device = grid.density.device
    return grid.contraction is None and device.type == "cpu" and backends.missing("native", device) is None
