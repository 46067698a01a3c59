"""Which rank owns which cells, and which voxels of an occupancy grid its cells reach.

k cells, v voxels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.distributed.group import Group
from voronerf.ops.ray_runs.reference import OwnSamples, own_samples
from voronerf.rendering.cameras import Rays
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.samplers import Occupancy, Stratified

#: Voxels compared with all centres at a time.
_CHUNK = 1 << 14


class Sharing:
    """The cells and samples of this rank among those of a group.

    Until the first split all ranks have the one network, and each evaluates a slice of the rays. Afterwards each
    evaluates its own cells on all rays.

    Attributes:
        group: The ranks.
        diagram: All cells; None before the first split, like the rest.
        owner: int64 [k], the rank of each cell.
        numbers: int32 [k], the number of each cell among own ones, or -1.
        reached: bool [v], the voxels of an occupancy grid that own cells reach; None without a grid.
        several: bool [v], those that cells of two or more ranks reach; None without a grid.
    """

    def __init__(self, group: Group) -> None:
        self.group = group
        self.forget()

    def forget(self) -> None:
        """Goes back to one network for all ranks."""
        self.diagram: VoronoiDiagram | None = None
        self.owner = self.numbers = torch.zeros(1, dtype=torch.int64)
        self.reached: Tensor | None = None
        self.several: Tensor | None = None

    def take(self, diagram: VoronoiDiagram, owner: Tensor, grid: OccupancyGrid | None) -> None:
        """Takes the own cells of a diagram; the grid forgets what they do not reach.

        Args:
            diagram: All cells.
            owner: int64 [k], the rank of each.
            grid: That of this rank, or None.
        """
        self.diagram, self.owner = diagram, owner.to(self.group.device)
        own = self.owner == self.group.rank
        self.numbers = torch.where(own, own.cumsum(0) - 1, -1).to(torch.int32)
        if grid is not None:
            reached = voxels_of_ranks(diagram, owner, grid, self.group.size)
            self.reached, self.several = reached[self.group.rank], reached.sum(0) > 1
            self.empty_others(grid)

    def cells(self) -> Tensor:
        """The own cells, int64 [own], ascending."""
        return (self.owner == self.group.rank).nonzero()[:, 0].cpu()

    def bounds(self, rays: int) -> list[int]:
        """The rays that each rank puts together: from its number to before the next."""
        return [rays * rank // self.group.size for rank in range(self.group.size + 1)]

    def slice(self, rays: int) -> slice:
        """The rays that this rank puts together."""
        return slice(*self.bounds(rays)[self.group.rank :][:2])

    def owned(self, positions: Tensor, backend: str) -> tuple[Tensor, Tensor]:
        """The cell of each position [n], int32, and the number of each cell among those of this rank, or -1."""
        if self.diagram is None:
            zeros = torch.zeros(len(positions), dtype=torch.int32, device=positions.device)
            return zeros, zeros[:1] if len(positions) else zeros.new_zeros(1)
        return self.diagram.locate(positions, backend=backend), self.numbers

    def evaluates(self, positions: Tensor, backend: str) -> Tensor:
        """Which of the positions [n] this rank evaluates when all have the same ones, bool [n]."""
        if self.diagram is None:
            own = torch.zeros(len(positions), dtype=torch.bool, device=positions.device)
            own[self.slice(len(positions))] = True
            return own
        cells, numbers = self.owned(positions, backend)
        return numbers[cells] >= 0

    def samples(
        self,
        sampler: Stratified,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
        picture: bool = False,
    ) -> OwnSamples:
        """The samples that this rank evaluates: those that one process would, with the same random numbers.

        Args:
            sampler: Of a single pass.
            rays: r rays, the same on all ranks.
            near: [r].
            far: [r].
            jitter: Random samples.
            generator: In the same state on all ranks.
            picture: Whether the strata are those of a picture.
        """
        kept = slice(0, len(rays)) if self.diagram is not None else self.slice(len(rays))
        if picture and isinstance(sampler, Occupancy):
            known, _ = sampler.march(rays[kept], near[kept], far[kept], picture=True)
        else:
            known = sampler.sample(rays, near, far, jitter=jitter, generator=generator, kept=kept)
        cells, numbers = self.owned(known.positions, sampler.backend)
        along = known.positions, known.ray_index + kept.start, known.depths, known.deltas
        hidden = self.diagram is not None and isinstance(sampler, Occupancy)
        return own_samples(*along, cells, numbers, bent=sampler.space.contraction is not None, hidden=hidden)

    def empty_others(self, grid: OccupancyGrid) -> None:
        """Empties the voxels that own cells do not reach; they have no samples then."""
        if self.reached is not None:
            grid.density.view(-1)[~self.reached] = 0
            grid.occupied.view(-1)[~self.reached] = False


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


def voxels_of_ranks(diagram: VoronoiDiagram, owner: Tensor, grid: OccupancyGrid, ranks: int) -> Tensor:
    """Which voxels the cells of each rank reach: bool [ranks, v]; too many rather than too few.

    In a box about p with half sides e, the difference of the squared distances to centres i and j is at least that at p
    less ``2 sum |c_i - c_j| e``. A cell that loses to the nearest centre of p by more does not reach the box.
    """
    device = grid.box.device
    half = (grid.box[1] - grid.box[0]) / torch.tensor(grid.occupied.shape, device=device) / 2 * 1.001
    voxels = torch.arange(grid.occupied.numel(), device=device)
    reached = torch.zeros(ranks, len(voxels), dtype=torch.bool, device=device)
    offsets, child = diagram.child_offsets.tolist(), diagram.child.tolist()
    owners = owner.tolist()
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
                reached[owners[-child[row] - 1], inside] = True
            elif len(inside):
                pending.append((child[row], inside))
    return reached
