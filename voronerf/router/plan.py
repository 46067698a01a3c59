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
        may_group: Whether another batch may run grouped although the first did not.
        small: Whether the plan was made for fewer than ``FEWEST`` samples; the first larger call makes another plan.
        choices: For each size (:meth:`size`), the index of the chosen way in ``ways``, and the reason for the choice.
            For a single cell, the grouped way is not counted in the index.
        lost_timings: For each size, the number of timings in which the fused way was clearly slower; the earliest time
            of the next timing, in seconds of ``time.monotonic``; and an explanation.
        constants: The arguments of the traced call that are not tensors, by name; only for the fused way.
        watch: The values of the module that the trace has read.
        counts: For each number in the results that counts samples, by name, its multiple of n.
        skip: The number of calls that run cell by cell before another way is tried again.
        wait: The value of ``skip`` after the next batch that cannot be grouped.
    """

    ways: list[Way]
    measured: bool = False
    may_group: bool = False
    small: bool = False
    choices: dict[tuple[int, int], tuple[int, str]] = field(default_factory=dict)
    lost_timings: dict[tuple[int, int], tuple[int, float, str]] = field(default_factory=dict)
    constants: dict[str, Any] = field(default_factory=dict)
    watch: Watch = field(default_factory=Watch)
    counts: dict[str, int] = field(default_factory=dict)
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
        if self.skip or (self.small and n >= FEWEST):
            return False
        if not self.measured or len(self.ways) == 1 or n < FEWEST:
            return True
        return self.choices.get(self.size(n, k), (1, ""))[0] == 0

    def size(self, n: int, k: int) -> tuple[int, int]:
        """Returns the key of ``choices``: the size class of the batch, which spans a factor of four, and k."""
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
    """Returns the maximum number of samples of a timing.

    The maximum is higher if the module is fused in several parts: the tensors between the parts outgrow the cache in
    large batches only, and the timing must include this cost.
    """
    return SLICE * 8 if any(way.name == "fused in runs" for way in ways) else SLICE
