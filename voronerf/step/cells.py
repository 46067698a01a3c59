"""What becomes of the cells between steps: samples are kept, cells are split, empty space is found.

m samples, k children of a cell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.reservoir import SampleReservoir
from voronerf.diagram.subdivision import Split, split_diagram
from voronerf.distributed.group import Group
from voronerf.distributed.pictures import LookOverRanks
from voronerf.distributed.sharing import Sharing, assign_cells
from voronerf.ops.select_heaviest import select_heaviest
from voronerf.rendering.occupancy import OccupancyGrid, density_of
from voronerf.rendering.renderer import Renderer
from voronerf.router import VoronoiRouter
from voronerf.router.grouping import cell_parameters
from voronerf.step.ray_loss import Found
from voronerf.step.schedule import PlannedSplit

#: Steps between evaluations of random voxels of the occupancy grid, the share of all that are evaluated, and how many
#: at most: as many as a few steps have samples.
REVISIT_EVERY, REVISITED, MOST_REVISITED = 16, 1 / 8, 32_768
#: The factor on what a voxel remembers for each sample of a batch in it.
DECAY = 0.8
#: Steps between tries to split the worst cell.
SPLIT_EVERY = 5


@dataclass(frozen=True)
class SplitRule:
    """How cells are split, and what of a run is kept for it.

    Attributes:
        centres: Of the new cells, see `split_diagram`, like the next two.
        uniform_scale: Of a regular grid of centres.
        balance: "published" or "transport".
        min_samples: A cell with fewer kept samples is not split further.
        inherit: Whether new cells start as copies of their parent, else from random parameters.
        reservoir: Samples that are kept.
        batches: The latest batches that they come from.

    Examples:
        >>> from voronerf.step import SplitRule
        >>> SplitRule(reservoir=2_000, batches=100).inherit
        True
    """

    centres: str = "centroidal"
    uniform_scale: float = 1.0
    balance: str = "published"
    min_samples: int = 64
    inherit: bool = True
    reservoir: int = 10_000
    batches: int = 500


class Cells:
    """The cells of a run: who calls :class:`Step` asks this before a step, and tells it afterwards what was found.

    Attributes:
        reservoir: The samples that are kept for the next split.
        splits: How many were made.
        sharing: Which cells are on which rank.

    Args:
        renderer: Whose sampler may have an occupancy grid.
        routers: The networks by name; "field" decides the cells. One named "proposal" is not split.
        plan: The splits to make.
        rule: How they are made.
        generator: Of random choices, in the same state on all ranks.
        sharing: That of the step; None for this process alone.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.rendering import Rays, Renderer, Stratified
        >>> from voronerf.step import Batch, Cells, PlannedSplit, SplitRule, Step
        >>> router = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
        >>> optimizer = torch.optim.Adam(router.parameters(), lr=0.01)
        >>> step = Step(Renderer({"field": router}, Stratified(8)))
        >>> plan, generator = [PlannedSplit(at=3, children=4, cells="all")], torch.Generator().manual_seed(0)
        >>> cells = Cells(step.renderer, {"field": router}, plan, SplitRule(), generator=generator)
        >>> rays = Rays(torch.zeros(9, 3), torch.nn.functional.normalize(torch.randn(9, 3)))
        >>> batch = Batch(rays, torch.ones(9), torch.full((9,), 3.0), torch.rand(9, 3))
        >>> for number in range(4):
        ...     if cells.is_due(number, number) and (split := cells.find_split()):
        ...         cells.divide(split, optimizer)
        ...     cells.revisit(number)  # some of empty space
        ...     optimizer.zero_grad()
        ...     found = step.run(batch, generator, backward=True)
        ...     optimizer.step()
        ...     cells.observe(found)
        ...     cells.reservoir.add(found.samples.positions, found.importance())
        >>> router.num_cells
        4
    """

    def __init__(
        self,
        renderer: Renderer,
        routers: Mapping[str, VoronoiRouter],
        plan: Sequence[PlannedSplit],
        rule: SplitRule,
        *,
        generator: torch.Generator,
        sharing: Sharing | None = None,
    ) -> None:
        self.renderer, self.routers, self.plan, self.rule = renderer, routers, plan, rule
        self.generator, self.sharing = generator, sharing or Sharing(Group(next(routers["field"].parameters()).device))
        self.splits = 0
        self.weights = torch.ones(1)  # what the networks of each cell cost, by which ranks share them
        self.empty_reservoir()
        if self.sharing.group.size > 1:
            renderer.look = LookOverRanks(renderer, self.sharing)

    def empty_reservoir(self) -> None:
        """Forgets the kept samples."""
        device = next(self.routers["field"].parameters()).device
        self.reservoir = SampleReservoir(self.rule.reservoir, self.rule.batches, device=device)

    @property
    def grid(self) -> OccupancyGrid | None:
        """The occupancy grid of the sampler."""
        return self.renderer.occupancy

    @property
    def diagram(self) -> VoronoiDiagram:
        """All cells of the run."""
        return self.sharing.diagram or self.routers["field"].diagram

    @property
    def planned(self) -> PlannedSplit | None:
        """The next split; None after the last, when no samples are kept any more."""
        return self.plan[self.splits] if self.splits < len(self.plan) else None

    def is_due(self, now: float, step: int) -> bool:
        """Whether the next split is to be made before a step, at a time in the unit of the plan."""
        # While no cell holds enough samples, a split of the worst cell is tried again.
        planned = self.planned
        return planned is not None and now >= planned.at - 1e-9 and (planned.most is None or step % SPLIT_EVERY == 0)

    # --- samples -----------------------------------------------------------------------------------------------------

    def revisit(self, step: int) -> None:
        """Before some steps, evaluates the field in random voxels, so that what was wrongly found empty comes back."""
        grid = self.grid
        if grid is None or step % REVISIT_EVERY:
            return
        self.routers["field"].eval()
        every = grid.occupied.numel()
        count = min(max(1, int(every * REVISITED)), MOST_REVISITED)
        voxels = torch.randint(every, (count,), generator=self.generator, device=self.generator.device)
        field = self.renderer.field if self.sharing.group.size == 1 else self._field_of_all
        given: dict[str, Any] = {"decay": 1.0, "generator": self.generator, "backend": self.renderer.backend}
        grid.update(field, voxels.to(grid.occupied.device), **given)
        self.sharing.empty_others(grid)

    def _field_of_all(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """The density that all ranks find, each at the positions that it evaluates."""
        own = self.sharing.evaluates(positions, self.renderer.backend)
        density = torch.zeros_like(positions[:, 0])
        density[own] = density_of(self.renderer.field, positions[own])
        return torch.zeros_like(positions), self.sharing.group.largest(density)

    def heaviest(self, found: Found) -> Tensor:
        """The own samples [n, 4] that may be kept, with their importance, as many on each rank; none after the last
        split."""
        if self.planned is None:
            return found.weights.new_empty(0, 4)
        kept = found.weights.new_zeros(self.reservoir.quota, 4)
        points, importance = select_heaviest(found.samples.positions, found.importance(), len(kept))
        kept[: len(points), :3], kept[: len(points), 3] = points, importance
        return kept

    def tell(self, found: Found) -> Tensor:
        """What other ranks should know of the voxels that samples lie in, [c, 2]; see `OccupancyGrid.tell`."""
        grid = self.grid
        if grid is None or self.sharing.group.size == 1:
            return found.weights.new_empty(0, 2)
        samples = _observed(found)
        return grid.tell(*samples, several=self.sharing.several, backend=self.renderer.backend)

    def observe(self, found: Found, told: Tensor | None = None) -> None:
        """Teaches the occupancy grid what the samples of a step found, and those of other ranks.

        Args:
            found: Of the step.
            told: [c, 2], what the other ranks :meth:`tell`; None for this process alone.
        """
        if self.grid is not None:
            given: dict[str, Any] = {"told": told, "reached": self.sharing.reached, "backend": self.renderer.backend}
            self.grid.observe(*_observed(found), decay=DECAY, **given)

    # --- splits ------------------------------------------------------------------------------------------------------

    def find_split(self, sample: Callable[[], Tensor] | None = None) -> Split | None:
        """The next split, as far as cells hold enough samples; rank 0 finds it, for machines may round in other ways.

        Args:
            sample: Gives positions of a step on this rank, from which ranks learn what each cell costs; the first split
                over ranks needs it.

        Returns:
            The split; None if there are fewer samples than it has children.
        """
        planned, rule, group = self.planned, self.rule, self.sharing.group
        assert planned is not None
        points, importance = self.reservoir.samples()
        k, split = self.children, None
        if group.rank == 0 and len(points) >= k:
            split = split_diagram(
                self.diagram,
                points,
                importance,
                k,
                cells=planned.cells,
                centres=rule.centres,
                uniform_scale=rule.uniform_scale,
                method=rule.balance,
                min_samples=0 if self.diagram.num_cells == 1 else rule.min_samples,
                generator=self.generator,
                backend=self.renderer.backend,
            )
        if group.size > 1:
            split, state = group.from_first((split, self.generator.get_state()))
            self.generator.set_state(state)
            if split is not None and sample is not None:
                cells = split.diagram.locate(sample(), backend=self.renderer.backend)
                self.weights = group.total(torch.bincount(cells, minlength=split.diagram.num_cells).float()).cpu()
        return split

    @property
    def children(self) -> int:
        """Of each cell in the next split."""
        planned = self.planned
        assert planned is not None
        most = planned.most
        return planned.children if most is None else min(planned.children, most - self.diagram.num_cells + 1)

    def divide(self, split: Split, optimizer: torch.optim.Optimizer) -> None:
        """Gives the networks the cells of a split, or those of this rank: children stay with the rank of their parent.

        Args:
            split: Of :meth:`find_split`.
            optimizer: Of the networks; its moments are inherited, too.
        """
        sharing = self.sharing
        if sharing.group.size == 1:
            for name, router in self.routers.items():
                if name != "proposal":
                    router.subdivide(split.diagram, split.parents, optimizer=optimizer, inherit=self.rule.inherit)
            return
        if sharing.diagram is None:
            before = torch.zeros(1, dtype=torch.int64)
            owner = assign_cells(split.diagram.leaf_centres, self.weights, sharing.group.size)
        else:
            before, owner = sharing.cells(), sharing.owner[split.parents.to(sharing.owner.device)]
        cells = (owner == sharing.group.rank).nonzero()[:, 0].cpu()
        self.take(split.diagram, owner, torch.searchsorted(before, split.parents.cpu()[cells]), optimizer)

    def take(self, diagram: VoronoiDiagram, owner: Tensor, parents: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Keeps the networks of own cells alone.

        Args:
            diagram: All cells.
            owner: int64 [k], the rank of each.
            parents: int64 [own], for each own cell the network that it gets.
            optimizer: Of the networks.
        """
        cells = (owner == self.sharing.group.rank).nonzero()[:, 0].cpu()
        self.routers["field"].subdivide(diagram.part(cells), parents, optimizer=optimizer, inherit=self.rule.inherit)
        self.sharing.take(diagram, owner, self.grid)

    def shared_parameters(self, optimizer: torch.optim.Optimizer) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """The parameters that all ranks have: those that a step updates whole, and tables."""
        own = set() if self.sharing.diagram is None else set(map(id, cell_parameters(self.routers["field"].module)))
        found: tuple[list[nn.Parameter], list[nn.Parameter]] = [], []
        for group in optimizer.param_groups:
            found[bool(group.get("sparse"))].extend(p for p in group["params"] if id(p) not in own)
        return found


def _observed(found: Found) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return found.samples.positions, found.density, found.samples.deltas, found.weights
