"""Cell splits in a training: kept samples determine the new cells, which inherit the networks of their parents.

m samples, k cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.reservoir import SampleReservoir
from voronerf.diagram.subdivision import Split, split_diagram
from voronerf.nerf.distributed import ALONE, Ranks
from voronerf.nerf.replay import replayed
from voronerf.nerf.volume import RenderOutput
from voronerf.router import VoronoiRouter

#: Default times of splits as fractions of the training: for a single split, and for the first and the last of several.
ONLY, FIRST, LAST = 0.2, 0.15, 0.5
#: A cell with fewer kept samples is not split further.
MIN_SAMPLES = 64
#: The number of kept samples (Elsner et al. 2023, section 3.1), and the number of latest batches that they come from.
RESERVOIR, BATCHES = 10_000, 500
#: Steps between attempts to split the worst cell while no cell holds enough samples.
TRY_EVERY = 5


@dataclass(frozen=True)
class PlannedSplit:
    """A planned split of cells.

    Attributes:
        at: The time of the split: a fraction of the training if below 1, else a number of steps.
        children: Number of new cells for each split cell.
        cells: "all" to split all cells, or "worst" to split only the cell with the largest accumulated error.
        max_cells: Largest number of cells after the split, only for "worst"; None for no limit.

    Raises:
        ValueError: ``max_cells`` with ``cells="all"``.

    Examples:
        >>> from voronerf.nerf import PlannedSplit
        >>> PlannedSplit(at=0.2, children=16).max_cells is None
        True
    """

    at: float
    children: int
    cells: Literal["all", "worst"] = "all"
    max_cells: int | None = None

    def __post_init__(self) -> None:
        if self.cells == "all" and self.max_cells is not None:
            raise ValueError(f"PlannedSplit: max_cells needs cells='worst', got cells='all' and {self.max_cells}")


def plan_splits(
    cells: Sequence[int], times: Sequence[float] | None = None, max_cells: int | None = None
) -> tuple[PlannedSplit, ...]:
    """Returns the splits of a training, in order.

    Args:
        cells: For each split in order, the number of children per split cell.
        times: The time of each split, as ``PlannedSplit.at``; with ``max_cells`` the times of the first and the last
            split. By default, a single split is at 0.2, and several splits are evenly spaced from 0.15 to 0.5.
        max_cells: The number of cells to reach. After the first split, the worst cell is repeatedly split into
            ``cells[-1]`` children, at evenly spaced times; the last split may make fewer children. None to split all
            cells each time.
    """
    levels = len(cells) if max_cells is None else 2
    if times is None:
        times = [ONLY] * levels if levels < 2 else [FIRST + (LAST - FIRST) * i / (levels - 1) for i in range(levels)]
    if max_cells is None:
        return tuple(PlannedSplit(at, k) for k, at in zip(cells, times, strict=True))
    first, last = times
    children = cells[-1]
    count = -(-(max_cells - cells[0]) // (children - 1))
    further = (
        PlannedSplit(first + (last - first) * (i + 1) / count, children, "worst", max_cells) for i in range(count)
    )
    return (PlannedSplit(first, cells[0]), *further)


def final_cells(plan: Sequence[PlannedSplit]) -> int:
    """Returns the number of cells after all splits of a plan, if every cell holds enough samples to be split."""
    cells = 1
    for split in plan:
        cells = cells * split.children if split.cells == "all" else cells + split.children - 1
        cells = cells if split.max_cells is None else min(cells, split.max_cells)
    return cells


class SplitDone(NamedTuple):
    """The result of a split.

    Attributes:
        split: The result of `split_diagram`. Its ``balances`` are empty if no cell held enough samples.
        points: [m, 3], the samples from which the new cells were computed.
        importance: [m], the importance of each sample.
    """

    split: Split
    points: Tensor
    importance: Tensor


replayed(SampleReservoir)


@replayed
class Strategy:
    """The base class of rules for splitting cells in a training; this class itself never splits a cell.

    Before each step the training loop calls :meth:`step_pre_backward`, which splits if :meth:`is_due`. It is the only
    hook that may change networks and optimiser. After the optimiser, each step
    calls :meth:`step_post_backward`, which may change only the strategy itself. The tensors that the hook receives
    belong to the step, and must be read before the hook returns. A subclass's own hooks run in Python in every
    step; see :class:`TrainingStep`.

    Attributes:
        inherit: Whether new cells start as copies of their parent.
        splits: The number of splits made.
        remaining: The number of splits still planned.
        ranks: The processes of a data-parallel training, set by `TrainingStep`.

    Examples:
        >>> from voronerf.nerf import Strategy
        >>> Strategy().is_due(0.5, step=10)
        False
    """

    inherit: bool = True
    splits: int = 0
    ranks: Ranks = ALONE

    @property
    def remaining(self) -> int:
        """The number of splits still planned."""
        return 0

    def is_due(self, fraction: float, step: int) -> bool:
        """Returns whether the next split is due; the arguments are as in :meth:`step_pre_backward`."""
        return False

    def step_pre_backward(
        self, optimizer: torch.optim.Optimizer | None, fraction: float, step: int
    ) -> SplitDone | None:
        """Makes the next split if it is due; called before each step.

        Args:
            optimizer: The optimiser of the networks; None for none.
            fraction: The completed fraction of the training, 0..1.
            step: The number of steps done.

        Returns:
            The split, or None if there was none.
        """
        return None

    def step_post_backward(self, output: RenderOutput) -> None:
        """Collects data for the next split from a step, after its loss was computed.

        Args:
            output: The result of :class:`voronerf.nerf.RayLoss`.
        """

    def forget(self) -> None:
        """Drops the data that was collected for the next split."""

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the tensors from which `load_state_dict` restores the strategy."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores the strategy from a result of `state_dict`.

        Raises:
            ValueError: The state belongs to another strategy.
        """


@replayed
class SplitStrategy(Strategy):
    """A strategy that splits cells at planned times, guided by sample errors (Elsner et al. 2023, section 3).

    Call :meth:`step_pre_backward` before each step of a training and :meth:`step_post_backward` after its loss.

    Attributes:
        reservoir: The kept samples for the next split.
        splits: The number of splits made.

    Args:
        routers: The routers by name, which are all split in the same way; "field" holds the diagram.
        plan: The splits to make.
        centres: The method that places the new centres, see `split_diagram`.
        inherit: Whether new cells start as copies of their parent instead of from random parameters.
        min_samples: A cell with fewer kept samples is not split further.
        reservoir: The number of samples to keep.
        batches: The number of latest batches from which samples are kept.
        generator: CPU generator of random choices; None for torch's global generator.
        backend: The backend of the ops.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.nerf import Batch, PlannedSplit, RayLoss, Rays, Renderer, SplitStrategy, Stratified
        >>> router = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
        >>> optimizer = torch.optim.Adam(router.parameters(), lr=0.01)
        >>> loss = RayLoss(Renderer({"field": router}, Stratified(8)))
        >>> strategy = SplitStrategy({"field": router}, [PlannedSplit(at=3, children=4)])
        >>> rays = Rays(torch.zeros(9, 3), torch.nn.functional.normalize(torch.randn(9, 3)))
        >>> batch = Batch(rays, torch.ones(9), torch.full((9,), 3.0), torch.rand(9, 3))
        >>> for step in range(4):
        ...     made = strategy.step_pre_backward(optimizer, step / 4, step)  # None, or a SplitDone
        ...     optimizer.zero_grad()
        ...     output = loss(batch, backward=True)
        ...     optimizer.step()
        ...     strategy.step_post_backward(output)
        >>> router.num_cells
        4
    """

    def __init__(
        self,
        routers: Mapping[str, VoronoiRouter],
        plan: Sequence[PlannedSplit],
        *,
        centres: str = "centroidal",
        inherit: bool = True,
        min_samples: int = MIN_SAMPLES,
        reservoir: int = RESERVOIR,
        batches: int = BATCHES,
        generator: torch.Generator | None = None,
        backend: str = "auto",
    ) -> None:
        self.routers, self.plan = dict(routers), tuple(plan)
        self.centres, self.inherit, self.min_samples = centres, inherit, min_samples
        self.generator, self.backend, self.splits = generator, backend, 0
        self.reservoir = SampleReservoir(reservoir, batches, device=self.diagram.centres.device)

    @property
    def diagram(self) -> VoronoiDiagram:
        """The Voronoi diagram of the cells."""
        return self.routers["field"].diagram

    @property
    def planned(self) -> PlannedSplit | None:
        """The next split, for which samples are kept; None after the last split."""
        return self.plan[self.splits] if self.splits < len(self.plan) else None

    @property
    def remaining(self) -> int:
        """The number of splits of the plan that are still to be made."""
        return len(self.plan) - self.splits

    def is_due(self, fraction: float, step: int) -> bool:
        """Returns whether the next split is due; the arguments are as in :meth:`step_pre_backward`."""
        planned = self.planned
        if planned is None or (planned.max_cells is not None and step % TRY_EVERY):
            return False
        return (fraction if planned.at < 1 else step) >= planned.at - 1e-9

    def step_pre_backward(
        self, optimizer: torch.optim.Optimizer | None, fraction: float, step: int
    ) -> SplitDone | None:
        """Splits the diagram, the networks and the optimiser's moments if the next split is due.

        Args:
            optimizer: The optimiser of the networks, whose moments new cells inherit; None for none.
            fraction: The completed fraction of the training, 0..1.
            step: The number of steps done.

        Returns:
            The split; None if no split was due, or if no cell holds enough samples for a split with ``max_cells``,
            which is then tried again later.

        Raises:
            ValueError: The first split has more cells than there are kept samples.
        """
        planned = self.planned
        if planned is None or not self.is_due(fraction, step):
            return None
        children, cells = planned.children, self.diagram.num_cells
        if planned.max_cells is not None:
            children = min(children, planned.max_cells - cells + 1)
        points, importance = self.reservoir.samples()
        points, importance = self.ranks.gather(points), self.ranks.gather(importance)
        if len(points) < children and self.splits == 0:
            raise ValueError(
                f"SplitStrategy: {children} cells need at least {children} samples, got {len(points)} after {step} "
                f"steps; split later"
            )
        split = Split(self.diagram, torch.arange(cells, device=self.diagram.centres.device), {})
        if len(points) >= children:
            split = split_diagram(
                self.diagram,
                points,
                importance,
                children,
                cells=planned.cells,
                centres=self.centres,
                min_samples=0 if cells == 1 else self.min_samples,
                generator=self.generator,
                backend=self.backend,
            )
        if planned.max_cells is not None and not split.balances:
            return None
        if split.balances:
            for router in self.routers.values():
                router.subdivide(split.diagram, split.parents, optimizer=optimizer, inherit=self.inherit)
        self.splits += 1
        self.forget()
        return SplitDone(split, points, importance)

    def forget(self) -> None:
        """Drops the samples that were kept for the next split."""
        kept, device = self.reservoir, self.diagram.centres.device
        self.reservoir = SampleReservoir(kept.capacity, kept.batches, device=device)

    def step_post_backward(self, output: RenderOutput) -> None:
        """Keeps the heaviest samples of a step, until the last split.

        Args:
            output: The result of :class:`voronerf.nerf.RayLoss`.
        """
        if self.planned is not None:
            samples = output.samples
            self.reservoir.add(
                samples.positions,
                output.weights,
                error=output.error,
                ray_index=samples.ray_index,
                backend="auto" if self.backend == "native" else self.backend,  # native has no CUDA kernel
            )

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the tensors from which `load_state_dict` restores the kept samples and the split count exactly."""
        return {**self.reservoir.state_dict(), "splits": torch.tensor(self.splits, device="cpu")}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores a result of `state_dict`; cells are restored by the routers, moments by the optimiser.

        Raises:
            ValueError: An entry is missing, or belongs to another reservoir or plan.
        """
        splits = int(state["splits"]) if "splits" in state else -1
        if not 0 <= splits <= len(self.plan):
            raise ValueError(f"SplitStrategy: splits must lie in 0..{len(self.plan)}, got {splits}")
        self.reservoir.load_state_dict(state)
        self.splits = splits
