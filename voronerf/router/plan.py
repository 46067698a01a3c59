"""The plan for calls of one kind: the way in which they run, and the values that this way depends on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from voronerf.router.fused import Fused
from voronerf.router.grouped import Loop, Way
from voronerf.router.probe import FEWEST
from voronerf.router.watch import Source, Watch, same


@dataclass
class CallPlan:
    """A plan for the calls of one kind.

    Attributes:
        way: The first way that is possible and agrees with the loop.
        loop: The loop over cells, which runs the batches for which ``way`` is impossible.
        may_group: Whether another batch may run grouped although the first did not.
        small: Whether the plan was made for fewer than ``FEWEST`` samples; the first larger call makes another plan.
        constants: The arguments of the traced call that are not tensors, by name; only for the fused way.
        watch: The values of the module that the trace has read.
        counts: For each number in the results that counts samples, by name, its multiple of n.
        skip: The number of calls that run cell by cell before another way is tried again.
        wait: The value of ``skip`` after the next batch that cannot be grouped.
    """

    way: Way
    loop: Loop
    may_group: bool = False
    small: bool = False
    constants: dict[str, Any] = field(default_factory=dict)
    watch: Watch = field(default_factory=Watch)
    counts: dict[str, int] = field(default_factory=dict)
    skip: int = 0
    wait: int = 0

    @property
    def fused(self) -> Fused | None:
        """The fused way, or None."""
        return self.way if isinstance(self.way, Fused) else None

    def is_ready(self, n: int) -> bool:
        """Returns whether a call of n samples runs in ``way`` and needs no other plan."""
        return not self.skip and (not self.small or n < FEWEST)

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
