"""The plan of calls of one kind: the ways that compute the same, and what was measured of them. n samples, k cells."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from voronerf.router.fused import Fused
from voronerf.router.grouped import Way
from voronerf.router.probe import FEWEST
from voronerf.router.watch import Source, Watch, same

SLICE = 8192  # samples of a batch that are measured


@dataclass
class CallPlan:
    """How the calls of one kind run.

    Attributes:
        ways: Those that give what the loop gives, the most promising first and the loop last.
        measured: Whether the first batch of each size decides between the ways; else the first one runs.
        open: Whether another batch may run grouped, though the first did not.
        few: Whether the plan was made for fewer than ``FEWEST`` samples; the first larger call makes another.
        chosen: The fastest way and why, by the size of a batch and the number of cells.
        lost: Measurements that the fused way has lost, by the same key: count, time of the next one, explanation.
        constants: What is no tensor among the arguments of the call that it was made for, if it is fused.
        watch: Values of the module that its trace read.
        skip: The next calls that run cell by cell before another way is tried again.
        wait: ``skip`` after the next batch that cannot be grouped.
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
        """The way that a call takes as it was traced."""
        return self.ways[0] if isinstance(self.ways[0], Fused) else None

    def takes_first(self, n: int, k: int) -> bool:
        """Whether n samples in k cells are known to go the first way."""
        if self.skip or (self.few and n >= FEWEST):
            return False
        if not self.measured or len(self.ways) == 1 or n < FEWEST:
            return True
        return self.chosen.get(self.size(n, k), (1, ""))[0] == 0

    def size(self, n: int, k: int) -> tuple[int, int]:
        """The key of ``chosen``: batches of up to four times as many samples."""
        return min(n, self._most).bit_length() // 2, k

    def changed(self, constants: dict[str, Any]) -> list[Source]:
        """The arguments, attributes and buffers that have changed since the module was traced."""
        fused = self.fused
        if fused is None:
            return []
        now = constants.keys() | self.constants.keys() if constants.keys() != self.constants.keys() else constants
        names = [n for n in now if not same(constants.get(n), self.constants.get(n)) and n not in fused.inputs.sources]
        return [*names, *self.watch.changed()]

    def postpone(self) -> None:
        """Runs the next calls cell by cell, twice as many each time."""
        self.skip, self.wait = self.wait, 2 * self.wait or 1


def measured_samples(ways: list[Way]) -> int:
    """Most samples on which ways are measured: more where PyTorch computes a part, whose tensors outgrow the cache."""
    return SLICE * 8 if any(way.name == "fused in runs" for way in ways) else SLICE
