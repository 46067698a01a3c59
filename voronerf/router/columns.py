"""Where the columns of a value come from, in a recorded call.

A segment is a range of columns of a value from before the layers, or of a layer's outputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.router.functions import MOVES
from voronerf.router.recording import Program, Ref, Step
from voronerf.router.rows import replace, tensors_in

_ROWS = 3


@dataclass(frozen=True)
class Segment:
    """Columns ``start`` to ``stop`` of a value, or of layer ``layer`` before or after its activation."""

    value: int
    layer: int
    activated: bool
    start: int
    stop: int

    def part(self, start: int, stop: int) -> Segment:
        """Some of its columns, counted from its own first."""
        return Segment(self.value, self.layer, self.activated, self.start + start, self.start + stop)

    def follows(self, other: Segment) -> bool:
        """Whether it goes on where another ends."""
        return other == Segment(self.value, self.layer, self.activated, other.start, self.start)


Columns = tuple[Segment, ...]


def join_segments(segments: Sequence[Segment]) -> Columns:
    """The same columns in as few segments as possible."""
    merged: list[Segment] = []
    for segment in segments:
        if merged and segment.follows(merged[-1]):
            last = merged.pop()
            segment = Segment(last.value, last.layer, last.activated, last.start, segment.stop)
        merged.append(segment)
    return tuple(merged)


def refs_in(value: Any) -> list[Ref]:
    """The values among a step's arguments."""
    found: list[Ref] = []
    replace(value, lambda item: found.append(item) if isinstance(item, Ref) else None)
    return found


def move_columns(step: Step, program: Program, columns: dict[int, Columns]) -> list[Columns] | None:
    """The columns of the results of a function that only moves columns; None for any other.

    Found by running it on rows of numbers that name columns.
    """
    if step.function not in MOVES:
        return None
    names: list[Segment] = []
    coded: dict[int, Tensor] = {}
    for ref in refs_in((step.args, step.kwargs)):
        if ref.value not in coded:
            singles = [s.part(i, i + 1) for s in columns[ref.value] for i in range(s.stop - s.start)]
            codes = torch.arange(len(names), len(names) + len(singles), dtype=torch.float64)
            names += singles
            m, *sizes = program.sizes[ref.value]
            rows = codes + 1e6 * torch.arange(_ROWS, dtype=torch.float64)[:, None]
            coded[ref.value] = rows.reshape(_ROWS * m, *sizes)
    given = replace((step.args, step.kwargs), lambda item: coded[item.value] if isinstance(item, Ref) else item)
    try:
        results = list(tensors_in(step.function(*given[0], **given[1])))
    except Exception:
        return None
    if len(results) != len(step.values):
        return None
    found = []
    for result, value in zip(results, step.values, strict=True):
        m, *sizes = program.sizes[value]
        if tuple(result.shape) != (_ROWS * m, *sizes) or result.dtype != torch.float64:
            return None
        rows = result.reshape(_ROWS, -1)
        if not torch.equal(rows, rows[:1] + 1e6 * torch.arange(_ROWS, dtype=torch.float64)[:, None]):
            return None
        found.append(join_segments([names[int(code)] for code in rows[0].tolist()]))
    return found
