"""When cells are split and into how many: the plan of a run, known before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

SplitKind = Literal["all", "worst"]
TimeUnit = Literal["fraction", "seconds", "steps"]

#: The first split, and the last one where there are several, as fractions of a run.
ONLY, FIRST, LAST = 0.2, 0.15, 0.5


@dataclass(frozen=True)
class PlannedSplit:
    """One split.

    Attributes:
        at: when, in the unit of the plan.
        children: of every cell that is split.
        cells: every cell, or only the one with the largest accumulated error.
        most: cells that there may be afterwards, or None for no limit.
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
        cells: children of a split, per level.
        times: when: one for each level; with ``max_cells`` the first and the last split.
        kind: what is split below the first level.
        max_cells: with kind "worst": after the first split the worst cell is split into ``cells[-1]`` again and again
            until there are that many cells, the last time into fewer where that fits; evenly spaced in time.
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
    """Cells at the end of a plan in which every cell holds enough samples to be split."""
    cells = 1
    for split in plan:
        cells = cells * split.children if split.cells == "all" else cells + split.children - 1
        cells = cells if split.most is None else min(cells, split.most)
    return cells
