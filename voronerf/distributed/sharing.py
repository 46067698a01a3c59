"""Which rank owns which cells, and which voxels of an occupancy grid its cells reach.

k cells, v voxels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.rendering.occupancy import OccupancyGrid

#: Voxels compared with all centres at a time.
_CHUNK = 1 << 14


@dataclass(frozen=True)
class Sharing:
    """The cells of all ranks.

    Attributes:
        diagram: All cells.
        owner: int64 [k], the rank of each.
    """

    diagram: VoronoiDiagram
    owner: Tensor

    def cells(self, rank: int) -> Tensor:
        """The cells of a rank, int64, ascending."""
        return (self.owner == rank).nonzero()[:, 0]

    def refined(self, diagram: VoronoiDiagram, parents: Tensor) -> Sharing:
        """The same after a split: children stay with the rank of their parent, so that no network has to move."""
        return Sharing(diagram, self.owner[parents.to(self.owner.device)])


def assign_cells(centres: Tensor, weights: Tensor, ranks: int) -> Tensor:
    """Gives each rank cells that lie together and weigh about the same.

    Space is halved along the longest side of the centres' box, so that both sides weigh what their ranks should, until
    a side has one rank.

    Args:
        centres: [k, 3].
        weights: [k] >= 0, such as the importance of the samples in each cell.
        ranks: At most k.

    Returns:
        int64 [k], the rank of each cell; every rank has one at least.

    Examples:
        >>> import torch
        >>> from voronerf.distributed.sharing import assign_cells
        >>> centres = torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
        >>> assign_cells(centres, torch.tensor([3.0, 1, 1, 1]), 2)
        tensor([0, 1, 1, 1])
    """
    owner = torch.zeros(len(centres), dtype=torch.int64)
    centres, weights = centres.cpu(), weights.cpu().double()
    pending = [(torch.arange(len(centres)), 0, ranks)]
    while pending:
        cells, first, count = pending.pop()
        if count == 1:
            owner[cells] = first
            continue
        places = centres[cells]
        axis = int((places.amax(0) - places.amin(0)).argmax())
        cells = cells[places[:, axis].argsort(stable=True)]
        left = count // 2
        heavy = weights[cells].cumsum(0)
        # The cut between two cells that comes nearest to the share of the ranks on its left.
        cut = 1 + int((heavy[:-1] - heavy[-1] * left / count).abs().argmin())
        cut = min(max(cut, left), len(cells) - (count - left))
        pending += [(cells[:cut], first, left), (cells[cut:], first + left, count - left)]
    return owner


def voxels_of_ranks(sharing: Sharing, grid: OccupancyGrid, ranks: int) -> Tensor:
    """Which voxels the cells of each rank reach: bool [ranks, v]; too many rather than too few.

    In a box about p with half sides e, the difference of the squared distances to centres i and j is at least that at p
    less ``2 sum |c_i - c_j| e``. A cell that loses to the nearest centre of p by more does not reach the box.
    """
    device = grid.box.device
    half = (grid.box[1] - grid.box[0]) / torch.tensor(grid.occupied.shape, device=device) / 2 * 1.001
    diagram, voxels = sharing.diagram, torch.arange(grid.occupied.numel(), device=device)
    reached = torch.zeros(ranks, len(voxels), dtype=torch.bool, device=device)
    offsets, child = diagram.child_offsets.tolist(), diagram.child.tolist()
    owner = sharing.owner.tolist()
    centres = diagram.centres.to(device)
    power = torch.zeros(len(centres), device=device) if diagram.power is None else diagram.power.to(device)
    pending = [(0, part) for part in voxels.split(_CHUNK)]
    while pending:
        node, part = pending.pop()
        rows = range(offsets[node], offsets[node + 1])
        own, points = centres[rows.start : rows.stop], grid.points(part)
        distances = (points[:, None] - own).square().sum(-1) - power[rows.start : rows.stop]
        least, nearest = distances.min(1)
        slack = 2 * ((own - own[nearest][:, None]).abs() * half).sum(-1)
        reach = distances - least[:, None] <= slack + 1e-6 * distances.abs()
        for column, row in enumerate(rows):
            inside = part[reach[:, column]]
            if child[row] < 0:
                reached[owner[-child[row] - 1], inside] = True
            elif len(inside):
                pending.append((child[row], inside))
    return reached
