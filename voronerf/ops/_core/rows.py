"""Numbers of rows, such as the rays and samples of a step, which a recording reads again (recording.py).

While nothing is recorded they are ints. In a recording they are :class:`RowCount`: an op gets one from the tensors that
it is given (:func:`rows_of`), makes memory for its results with it (:func:`new_empty`), and hands it to a compiled
function, whose parameter is a ``RowCount`` too (csrc/common/row_count.h).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.active import active


class Count:
    """Where a number of rows lies.

    Attributes:
        memory: int64 [1].
        most: What there is memory for.
        given: What gives it before each run; None for one that a call computes.
    """

    __slots__ = ("_number", "given", "memory", "most")

    def __init__(self, memory: Tensor, most: int, given: Callable[[], int] | None) -> None:
        self.memory, self.most, self.given = memory, most, given
        self._number = ctypes.c_int64.from_address(memory.data_ptr())

    @property
    def now(self) -> int:
        """What it is in this run."""
        return self._number.value

    @now.setter
    def now(self, rows: int) -> None:
        self._number.value = rows


class RowCount(int):
    """The rows of a `Count` and some more, of a recording. Compiled calls read them again from its memory.

    A sum or difference with an int is one, too; whatever else is computed of it is an int, which a compiled call that
    wants a number of rows refuses while it is recorded.
    """

    count: Count
    more: int
    address: int
    most: int

    @classmethod
    def of(cls, count: Count, more: int = 0) -> RowCount:
        """That of a count in this run, and so many more."""
        rows = cls(count.now + more)
        rows.count, rows.more, rows.address, rows.most = count, more, count.memory.data_ptr(), count.most
        return rows

    @property
    def now(self) -> int:
        """What it is in this run."""
        return self.count.now + self.more

    def __add__(self, more: Any) -> Any:
        return RowCount.of(self.count, self.more + more) if type(more) is int else int(self) + more

    def __sub__(self, less: Any) -> Any:
        return self + -less if type(less) is int else int(self) - less


def rows_of(tensor: Tensor) -> int:
    """How many rows a tensor has."""
    recording = active.recording
    rows: int = tensor.shape[0] if recording is None else recording.rows_of(tensor)
    return rows


def new_empty(like: Tensor, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
    """New memory beside a tensor; with a `RowCount` of rows there can be more of them in later runs."""
    recording = active.recording
    if recording is None or not (shape and isinstance(shape[0], RowCount)):
        # Of a tuple, and of a dtype, torch takes longer.
        sizes: Any = shape or ((),)
        return like.new_empty(*sizes) if dtype is None else like.new_empty(*sizes, dtype=dtype)
    memory: Tensor = recording.new_rows(like, shape, dtype)
    return memory


def read_count(memory: Tensor) -> int:
    """A number of rows that a call has computed, int64 [1]. Replays read it again from there."""
    if active.recording is None:
        return int(memory)
    rows: int = active.recording.computed(memory)
    return rows


def fixed_count(rows: int) -> int:
    """A number of rows that is the same in each run."""
    return rows if active.recording is None else active.recording.count(lambda: rows)


def following_count(rows: int, follows: Callable[[int], int]) -> int:
    """A number of rows that follows from another one, which is given. Replays find it again."""
    if not isinstance(rows, RowCount):
        return follows(rows)
    found: int = active.recording.count(lambda: follows(rows.now))
    return found


def varying(value: Callable[[], float]) -> float | Tensor:
    """A number that changes from run to run, rounded to float32. While it is recorded it is a tensor [] for replays."""
    return ctypes.c_float(value()).value if active.vary is None else active.vary(value)
