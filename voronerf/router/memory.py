"""What a router remembers between calls: assignments, plans, and what has been found out about the module."""

from __future__ import annotations

import weakref
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.fusion import Plan
from voronerf.router.grouping import Grouping
from voronerf.router.recording import Program
from voronerf.router.rows import Trials
from voronerf.router.snapshot import Snapshot


class Assignments:
    """The last assignment, for other methods that are called with the same positions."""

    def __init__(self) -> None:
        self._key: tuple[Any, ...] = ()
        self._source: weakref.ref[Tensor] | None = None
        self._version = 0
        self._positions: Tensor | None = None
        self._methods: set[str] = set()
        self._grouping: Grouping | None = None

    def find(self, method: str, source: Tensor | None, positions: Tensor, key: tuple[Any, ...]) -> Grouping | None:
        """The assignment made for the same positions, or None. One that was drawn serves each method once.

        Args:
            method: that is called.
            source: the tensor that holds the positions, or None where they have been computed.
            positions: [..., 3].
            key: what else the assignment depends on.
        """
        if self._grouping is None or key != self._key or positions.numel() == 0:
            return None
        if source is not None:
            known = self._source is not None and self._source() is source and source._version == self._version
        else:
            known = (
                self._positions is not None
                and self._positions.shape == positions.shape
                and self._positions.device == positions.device
                and torch.equal(self._positions, positions)
            )
        drawn = key[2]
        if not known or (drawn and method in self._methods):
            return None
        self._methods.add(method)
        return self._grouping

    def keep(
        self, method: str, source: Tensor | None, positions: Tensor, key: tuple[Any, ...], grouping: Grouping
    ) -> None:
        """Remembers an assignment."""
        if source is not None and source.is_inference():  # has no version that would tell of changes
            self._grouping = None
            return
        self._key, self._methods, self._grouping = key, {method}, grouping
        self._source = None if source is None else weakref.ref(source)
        self._version = 0 if source is None else source._version
        self._positions = positions.detach().clone() if source is None else None


class Memory(Trials):
    """What a router remembers between calls. Copies of a router begin anew.

    Attributes:
        assignments: the last one.
        kinds: of calls with as many arguments of the same types and sizes, those with other numbers and words.
        by_cell: why calls of a kind have to run cell by cell, once that is known.
        separate: the kinds of calls that have been found to treat samples one by one.
        flat: for kinds of calls with rays, which of the results the module itself flattens to [rays * samples, ...].
        plans: for calls in a state of the module, how the fused network runs them; a recording until it is confirmed
            by a second call; or why there is none.
        recorded: how many states calls of a kind have been recorded in.
        snapshot: reads the state of the module.
        names: of the positional arguments of methods.
    """

    def __init__(self) -> None:
        super().__init__()
        self.forget()

    def forget(self) -> None:
        """Begins anew, after a change of diagram, dtype or device."""
        self.assignments = Assignments()
        self.said = {topic for topic in self.said if not topic.endswith(" changes")}
        self.kinds: dict[Any, set[Any]] = {}
        self.by_cell: dict[Any, str] = {}
        self.separate: set[Any] = set()
        self.flat: dict[Any, tuple[bool, ...]] = {}
        self.plans: dict[Any, Plan | Program | str] = {}
        self.recorded: dict[Any, int] = {}
        self.snapshot: Snapshot | None = None
        self.names: dict[tuple[str, int], list[str]] = {}
        self._rows_at_once = 0

    def rows_at_once(self, module: nn.Module) -> int:
        """Rows that a module runs on at once on a CPU.

        An activation is then at most 16 MiB for the widest layer: the C library gives larger memory back to the
        system after each use, and fetching it again costs more than the products.
        """
        if not self._rows_at_once:
            widest = max((part.out_features for part in module.modules() if isinstance(part, nn.Linear)), default=64)
            self._rows_at_once = min(max(2**22 // widest, 2**12), 2**16)
        return self._rows_at_once

    def __deepcopy__(self, memo: Any) -> Memory:
        return Memory()

    def __reduce__(self) -> tuple[type[Memory], tuple[()]]:
        return Memory, ()
