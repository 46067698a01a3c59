"""What becomes of the cells between steps: samples are kept, cells are split, empty space is found.

m samples, k children of a cell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.reservoir import SampleReservoir, select_heaviest
from voronerf.diagram.subdivision import Split, split_diagram
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.ray_loss import RenderOutput
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Occupancy
from voronerf.nerf.schedule import PlannedSplit
from voronerf.router import VoronoiRouter

#: Steps between evaluations of random voxels of the occupancy grid, the share of all that are evaluated, and how many
#: at most: as many as a few steps have samples.
REVISIT_EVERY, REVISITED, MOST_REVISITED = 16, 1 / 8, 32_768
#: The factor on what a voxel remembers for each sample of a batch in it.
DECAY = 0.8
#: In a contracted sphere, the first steps of a run, in which the grid learns nothing. A young field is thin everywhere:
#: a grid would take it for empty, and what is emptied no longer learns.
SETTLING_STEPS = 400
#: Steps between tries to split the worst cell.
SPLIT_EVERY = 5


@dataclass(frozen=True)
class SplitRule:
    """How cells are split, and what of a run is kept for it.

    Attributes:
        centres: Of the new cells, see `split_diagram`.
        min_samples: A cell with fewer kept samples is not split further.
        inherit: Whether new cells start as copies of their parent, else from random parameters.
        reservoir: Samples that are kept.
        batches: The latest batches that they come from.

    Examples:
        >>> from voronerf.nerf import SplitRule
        >>> SplitRule(reservoir=2_000, batches=100).inherit
        True
    """

    centres: str = "centroidal"
    min_samples: int = 64
    inherit: bool = True
    reservoir: int = 10_000
    batches: int = 500


class Cells:
    """The cells of a run: who calls :class:`Step` asks this before a step, and tells it afterwards what was found.

    Attributes:
        reservoir: The samples that are kept for the next split.
        splits: How many were made.
        outside: bool [v], voxels of the grid that stay empty, since they are of other territories; None for none.

    Args:
        renderer: Whose sampler may have an occupancy grid, and says which networks stay whole.
        routers: The networks by name; "field" decides the cells.
        plan: The splits to make.
        rule: How they are made.
        generator: Of random choices.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.nerf import Rays, Renderer, Stratified
        >>> from voronerf.nerf import Batch, Cells, PlannedSplit, SplitRule, Step
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
    ) -> None:
        self.renderer, self.routers, self.plan, self.rule = renderer, routers, plan, rule
        self.generator = generator
        self.splits = 0
        self.outside: Tensor | None = None
        self.empty_reservoir()

    def empty_reservoir(self) -> None:
        """Forgets the kept samples."""
        device = next(self.routers["field"].parameters()).device
        self.reservoir = SampleReservoir(self.rule.reservoir, self.rule.batches, device=device)

    @property
    def grid(self) -> OccupancyGrid | None:
        """The occupancy grid of the sampler."""
        return self.renderer.occupancy

    @property
    def sampler(self) -> Occupancy:
        """That of a renderer with a grid."""
        return cast(Occupancy, self.renderer.sampler)

    @property
    def diagram(self) -> VoronoiDiagram:
        """The cells."""
        return self.routers["field"].diagram

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
        """Before some steps, evaluates the field in random voxels, so that what was wrongly found empty comes back.

        In the first `SETTLING_STEPS` in a contracted sphere, tells the sampler that the grid has learnt nothing yet.
        """
        grid = self.grid
        if grid is None:
            return
        self.sampler.settling = isinstance(grid.contraction, Contraction) and step < SETTLING_STEPS
        if self.sampler.settling or step % REVISIT_EVERY:
            return
        self.routers["field"].eval()
        every = grid.occupied.numel()
        count = min(max(1, int(every * REVISITED)), MOST_REVISITED)
        voxels = torch.randint(every, (count,), generator=self.generator, device=self.generator.device)
        given: dict[str, Any] = {"decay": 1.0, "generator": self.generator, "backend": self.renderer.backend}
        grid.update(self.renderer.field, voxels.to(grid.occupied.device), **given)
        self.leave(self.outside)

    def fill_holes(self, seed: int) -> None:
        """After the last step, occupies voxels that were emptied in the middle of surfaces; see `OccupancyGrid`.

        In a contracted sphere alone: objects in a box and forward-facing scenes gain nothing by it.

        Args:
            seed: Of the points at which the field is asked.
        """
        if self.grid is not None and isinstance(self.grid.contraction, Contraction):
            self.routers["field"].eval()
            self.grid.fill_holes(self.renderer.field, generator=torch.Generator().manual_seed(seed))
            self.leave(self.outside)

    def leave(self, voxels: Tensor | None) -> None:
        """Empties voxels, bool [v], which have no samples then, and keeps them so."""
        self.outside = voxels
        if voxels is not None and self.grid is not None:
            self.grid.density.view(-1)[voxels] = 0
            self.grid.occupied.view(-1)[voxels] = False

    def heaviest(self, found: RenderOutput) -> Tensor:
        """The samples [n, 4] that may be kept, with their importance; none after the last split."""
        if self.planned is None:
            return found.weights.new_empty(0, 4)
        kept = found.weights.new_zeros(self.reservoir.quota, 4)
        points, importance = select_heaviest(found.samples.positions, found.importance(), len(kept))
        kept[: len(points), :3], kept[: len(points), 3] = points, importance
        return kept

    def observe(self, found: RenderOutput) -> None:
        """Teaches the occupancy grid what the samples of a step found."""
        if self.grid is not None and not self.sampler.settling:
            observed = found.samples.positions, found.density, found.samples.deltas, found.weights
            self.grid.observe(*observed, decay=DECAY, backend=self.renderer.backend)

    # --- splits ------------------------------------------------------------------------------------------------------

    def find_split(self) -> Split | None:
        """The next split, as far as cells hold enough samples; None if there are fewer samples than it has children."""
        planned, rule = self.planned, self.rule
        assert planned is not None
        points, importance = self.reservoir.samples()
        if len(points) < self.children:
            return None
        return split_diagram(
            self.diagram,
            points,
            importance,
            self.children,
            cells=planned.cells,
            centres=rule.centres,
            min_samples=0 if self.diagram.num_cells == 1 else rule.min_samples,
            generator=self.generator,
            backend=self.renderer.backend,
        )

    @property
    def children(self) -> int:
        """Of each cell in the next split."""
        planned = self.planned
        assert planned is not None
        most = planned.most
        return planned.children if most is None else min(planned.children, most - self.diagram.num_cells + 1)

    def divide(self, split: Split, optimizer: torch.optim.Optimizer) -> None:
        """Gives the networks the cells of a split.

        Args:
            split: Of :meth:`find_split`.
            optimizer: Of the networks; its moments are inherited, too.
        """
        for name, router in self.routers.items():
            if name not in self.renderer.sampler.whole:
                router.subdivide(split.diagram, split.parents, optimizer=optimizer, inherit=self.rule.inherit)
