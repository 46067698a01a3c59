"""When and where cells divide: samples are kept, the diagram is refined, the networks of new cells inherit.

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
from voronerf.nerf.segment import replayed
from voronerf.nerf.volume import RenderOutput
from voronerf.router import VoronoiRouter

#: Default times as fractions of a run: of a single split, and of the first and last of several.
ONLY, FIRST, LAST = 0.2, 0.15, 0.5
#: A cell with fewer kept samples is not split further.
MIN_SAMPLES = 64
#: Samples that are kept (Elsner et al. 2023, section 3.1), and the latest batches that they come from.
RESERVOIR, BATCHES = 10_000, 500
#: Steps between tries to split the worst cell, while no cell holds enough samples.
TRY_EVERY = 5


@dataclass(frozen=True)
class PlannedSplit:
    """One split.

    Attributes:
        at: When: below 1 a fraction of the training, from 1 on a number of steps.
        children: Number of new cells for each cell that is split.
        cells: "all" cells are split, or only the "worst", which has the largest accumulated error.
        most: Largest number of cells after the split, or None for no limit.

    Examples:
        >>> from voronerf.nerf import PlannedSplit
        >>> PlannedSplit(at=0.2, children=16).most is None
        True
    """

    at: float
    children: int
    cells: Literal["all", "worst"] = "all"
    most: int | None = None


def plan_splits(
    cells: Sequence[int], times: Sequence[float] | None = None, max_cells: int | None = None
) -> tuple[PlannedSplit, ...]:
    """The splits of a training, in order.

    Args:
        cells: Children of a split, for each level.
        times: One for each level, as ``PlannedSplit.at``; with ``max_cells`` those of the first and the last split.
            None: a single split at 0.2, several evenly spaced from 0.15 to 0.5.
        max_cells: After the first split, the worst cell is split into ``cells[-1]`` at evenly spaced times until there
            are this many cells; the last split may have fewer children.
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
    """Cells after all splits of a plan, if every cell holds enough samples to be split."""
    cells = 1
    for split in plan:
        cells = cells * split.children if split.cells == "all" else cells + split.children - 1
        cells = cells if split.most is None else min(cells, split.most)
    return cells


class SplitDone(NamedTuple):
    """A split that was made.

    Attributes:
        split: The refined diagram, parents and balances; without balances no cell held enough samples.
        points: [m, 3], the samples that decided it.
        importance: [m].
    """

    split: Split
    points: Tensor
    importance: Tensor


@replayed
class Strategy:
    """What a training asks of a rule when and where cells divide; this one never divides them.

    Before each step the loop asks :meth:`is_due`, and :meth:`has_samples` where a split can wait, and calls
    :meth:`step_pre_backward` where it is: networks and optimiser change there alone. After the optimiser each step
    calls :meth:`step_post_backward`, which may change the strategy itself; tensors of the output are the step's own
    memory, to be read before it returns. A recorded step calls what a subclass overrides, and makes the calls of the
    others again.

    Attributes:
        inherit: Whether new cells start as copies of their parent.
        splits: How many splits were made.
        left: How many are still planned.

    Examples:
        >>> from voronerf.nerf import Strategy
        >>> Strategy().is_due(0.5, step=10)
        False
    """

    inherit: bool = True
    splits: int = 0

    @property
    def left(self) -> int:
        """How many splits are still planned."""
        return 0

    def is_due(self, fraction: float, step: int) -> bool:
        """Whether the next split is to be made now; arguments as of :meth:`step_pre_backward`."""
        return False

    def has_samples(self) -> bool:
        """Whether enough samples were kept for the next split."""
        return True

    def step_pre_backward(
        self, optimizer: torch.optim.Optimizer | None, fraction: float, step: int
    ) -> SplitDone | None:
        """Called before each step: makes the next split if it is due.

        Args:
            optimizer: Of the networks; None for none.
            fraction: How much of the training is done, 0..1.
            step: Steps done.

        Returns:
            What was split; None for nothing.
        """
        return None

    def step_post_backward(self, output: RenderOutput) -> None:
        """Called after the loss of a step was computed.

        Args:
            output: What :class:`voronerf.nerf.RayLoss` gave.
        """

    def forget(self) -> None:
        """Drops what was learnt for the next split."""

    def state_dict(self) -> dict[str, Tensor]:
        """The tensors from which `load_state_dict` restores the strategy."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores what `state_dict` gave.

        Raises:
            ValueError: The state is of another strategy.
        """


@replayed
class SplitStrategy(Strategy):
    """Splits the cells of routers at planned times by the samples that are still wrong (Elsner et al. 2023, section 3).

    Call :meth:`step_pre_backward` before each step of a training and :meth:`step_post_backward` after its loss.

    Attributes:
        reservoir: The samples that are kept for the next split.
        splits: How many were made.

    Args:
        routers: The networks by name, which are split alike; "field" decides the cells.
        plan: The splits to make.
        centres: Of the new cells, see `split_diagram`.
        inherit: Whether new cells start as copies of their parent, else from random parameters.
        min_samples: A cell with fewer kept samples is not split further.
        reservoir: Samples that are kept.
        batches: The latest batches that they come from.
        generator: CPU generator of random choices; None for torch's global one.
        backend: Of the operations.

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
        """The cells."""
        return self.routers["field"].diagram

    @property
    def planned(self) -> PlannedSplit | None:
        """The next split; None after the last, when no samples are kept any more."""
        return self.plan[self.splits] if self.splits < len(self.plan) else None

    @property
    def left(self) -> int:
        """How many splits of the plan are still to be made."""
        return len(self.plan) - self.splits

    def has_samples(self) -> bool:
        """Whether the first split has a sample for each of its cells; later ones wait for them by themselves."""
        return self.splits > 0 or len(self.reservoir) >= (self.planned.children if self.planned else 0)

    def is_due(self, fraction: float, step: int) -> bool:
        """Whether the next split is to be made now; arguments as of :meth:`step_pre_backward`."""
        planned = self.planned
        if planned is None or (planned.most is not None and step % TRY_EVERY):
            return False
        return (fraction if planned.at < 1 else step) >= planned.at - 1e-9

    def step_pre_backward(
        self, optimizer: torch.optim.Optimizer | None, fraction: float, step: int
    ) -> SplitDone | None:
        """Makes the next split if it is due: diagram, networks and the optimiser's moments.

        Args:
            optimizer: Of the networks, whose moments are inherited, too; None for none.
            fraction: How much of the training is done, 0..1.
            step: Steps done.

        Returns:
            What was split; None where nothing was due, or where the worst cell does not hold enough samples yet.

        Raises:
            ValueError: When the first split has more cells than samples were kept.
        """
        planned = self.planned
        if planned is None or not self.is_due(fraction, step):
            return None
        children, cells = planned.children, self.diagram.num_cells
        if planned.most is not None:
            children = min(children, planned.most - cells + 1)
        points, importance = self.reservoir.samples()
        if len(points) < children and self.splits == 0:
            raise ValueError(
                f"SplitStrategy: more cells than samples: {children} cells are asked for, {len(points)} samples were "
                f"kept in {step} steps; split later"
            )
        split = Split(self.diagram, torch.arange(cells), {})
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
        if planned.most is not None and not split.balances:
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
            output: What :class:`voronerf.nerf.RayLoss` gave.
        """
        if self.planned is not None:
            samples = output.samples
            self.reservoir.add(
                samples.positions,
                output.weights,
                error=output.error,
                ray_index=samples.ray_index,
                backend="auto" if self.backend == "native" else self.backend,  # which has no CUDA kernel for it
            )

    def state_dict(self) -> dict[str, Tensor]:
        """The tensors from which `load_state_dict` restores the kept samples and the number of splits, bit for bit."""
        return {**self.reservoir.state_dict(), "splits": torch.tensor(self.splits)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores what `state_dict` gave; cells and moments are those of the routers and of the optimiser.

        Raises:
            ValueError: An entry is missing, or of another reservoir or plan.
        """
        splits = int(state["splits"]) if "splits" in state else -1
        if not 0 <= splits <= len(self.plan):
            raise ValueError(f"SplitStrategy: splits must lie in 0..{len(self.plan)}, got {splits}")
        self.reservoir.load_state_dict(state)
        self.splits = splits
