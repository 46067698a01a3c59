"""The plan for calls of one kind: the ways that give the same results, and their timings.

Letters: n samples, k cells.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from voronerf.router.fused import Fused
from voronerf.router.grouped import Way
from voronerf.router.probe import FEWEST
from voronerf.router.watch import Source, Watch, same

SLICE = 8192  # maximum number of samples in a timing


@dataclass
class CallPlan:
    """A plan for the calls of one kind.

    Attributes:
        ways: The ways that agree with the loop, the most promising first and the loop last.
        measured: Whether timings on the first batch of each size choose the way; else the first way runs.
        open: Whether another batch may run grouped although the first did not.
        few: Whether the plan was made for fewer than ``FEWEST`` samples; the first larger call makes another plan.
        chosen: The number of the fastest way and the reason, by the size of a batch and the number of cells.
        lost: The lost timings of the fused way, by the key of ``chosen``: their count, the time of the next timing, and
            an explanation.
        constants: The arguments of the traced call that are not tensors, by name; only for the fused way.
        watch: The values of the module that the trace has read.
        skip: The number of calls that run cell by cell before another way is tried again.
        wait: The value of ``skip`` after the next batch that cannot be grouped.
    """

    ways: list[Way]
    measured: bool = False
    open: bool = False
    few: bool = False
    chosen: dict[tuple[int, int], tuple[int, str]] = field(default_factory=dict)
    lost: dict[tuple[int, int], tuple[int, float, str]] = field(default_factory=dict)
    constants: dict[str, Any] = field(default_factory=dict)
    watch: Watch = field(default_factory=Watch)
    skip: int = 0
    wait: int = 0

    def __post_init__(self) -> None:
        self._most = measured_samples(self.ways)

    @property
    def fused(self) -> Fused | None:
        """The fused way, or None."""
        return self.ways[0] if isinstance(self.ways[0], Fused) else None

    def takes_first(self, n: int, k: int) -> bool:
        """Returns whether the first way is already chosen for n samples in k cells."""
        if self.skip or (self.few and n >= FEWEST):
            return False
        if not self.measured or len(self.ways) == 1 or n < FEWEST:
            return True
        return self.chosen.get(self.size(n, k), (1, ""))[0] == 0

    def size(self, n: int, k: int) -> tuple[int, int]:
        """Returns the key of ``chosen``, which is the same for sizes within a factor of four."""
        return min(n, self._most).bit_length() // 2, k

    def changed(self, constants: dict[str, Any]) -> list[Source]:
        """Lists the arguments, attributes and buffers that have changed since the module was traced."""
        fused = self.fused
        if fused is None:
            return []
        both = constants.keys() | self.constants.keys() if constants.keys() != self.constants.keys() else constants
        names = [n for n in both if not same(constants.get(n), self.constants.get(n)) and n not in fused.inputs.sources]
        return [*names, *self.watch.changed()]

    def postpone(self) -> None:
        """Makes the next calls run cell by cell, twice as many after each failure."""
        self.skip, self.wait = self.wait, 2 * self.wait or 1


def measured_samples(ways: list[Way]) -> int:
    """Returns the sample limit of a timing. It is higher for fused runs, as tensors between runs outgrow the cache."""
    return SLICE * 8 if any(way.name == "fused in runs" for way in ways) else SLICE
