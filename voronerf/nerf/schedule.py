"""The planned splits of a run: when, which cells, and into how many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

SplitKind = Literal["all", "worst"]
TimeUnit = Literal["fraction", "steps"]

#: Default times as fractions of a run: of a single split, and of the first and last of several.
ONLY, FIRST, LAST = 0.2, 0.15, 0.5


@dataclass(frozen=True)
class PlannedSplit:
    """One split.

    Attributes:
        at: time, in the unit of the plan.
        children: number of new cells for each cell that is split.
        cells: "all" cells are split, or only the "worst", which has the largest accumulated error.
        most: largest number of cells after the split, or None for no limit.

    Examples:
        >>> from voronerf.nerf import PlannedSplit
        >>> PlannedSplit(at=0.2, children=16, cells="all").most is None
        True
    """

    at: float
    children: int
    cells: SplitKind
    most: int | None = None


def default_times(count: int) -> tuple[float, ...]:
    """Fractions of the run at which ``count`` splits are made: one at 0.2, several evenly spaced from 0.15 to 0.5."""
    if count < 2:
        return (ONLY,) * count
    return tuple(FIRST + (LAST - FIRST) * i / (count - 1) for i in range(count))


def plan_splits(
    cells: Sequence[int], times: Sequence[float], kind: SplitKind = "all", max_cells: int | None = None
) -> tuple[PlannedSplit, ...]:
    """The splits of a run, in order.

    Args:
        cells: children of a split, for each level.
        times: one for each level; with ``max_cells`` those of the first and the last split.
        kind: which cells are split below the first level.
        max_cells: with kind "worst": after the first split, the worst cell is split into ``cells[-1]`` at evenly spaced
            times until there are this many cells; the last split may have fewer children.
    """
    if max_cells is None:
        return tuple(
            PlannedSplit(at, k, kind if level else "all")
            for level, (k, at) in enumerate(zip(cells, times, strict=True))
        )
    first, last = times
    children = cells[-1]
    count = -(-(max_cells - cells[0]) // (children - 1))
    further = (
        PlannedSplit(first + (last - first) * (i + 1) / count, children, "worst", max_cells) for i in range(count)
    )
    return (PlannedSplit(first, cells[0], "all"), *further)


def final_cells(plan: Sequence[PlannedSplit]) -> int:
    """Cells after all splits of a plan, if every cell holds enough samples to be split."""
    cells = 1
    for split in plan:
        cells = cells * split.children if split.cells == "all" else cells + split.children - 1
        cells = cells if split.most is None else min(cells, split.most)
    return cells
