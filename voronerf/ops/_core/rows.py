"""Numbers of rows, such as a step's rays and samples, which replays of a recording read again (recording.py).

Outside a recording, a number of rows is an int. In a recording it is a :class:`RowCount`: an op reads it from its
tensors (:func:`rows_of`), allocates its results with it (:func:`new_empty`), and passes it to a compiled function
(csrc/common/row_count.h).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.active import active


class Count:
    """A number of rows in memory.

    Attributes:
        memory: The number, int64 [1].
        capacity: The largest number for which memory is allocated.
        read: The function that returns the number before each replay; None if a compiled call computes it.
    """

    __slots__ = ("_number", "capacity", "memory", "read")

    def __init__(self, memory: Tensor, capacity: int, read: Callable[[], int] | None) -> None:
        self.memory, self.capacity, self.read = memory, capacity, read
        self._number = ctypes.c_int64.from_address(memory.data_ptr())

    @property
    def now(self) -> int:
        """The number of rows in this run."""
        return self._number.value

    @now.setter
    def now(self, rows: int) -> None:
        self._number.value = rows


class RowCount(int):
    """A number of rows in a recording: a `Count` plus a constant. Compiled calls read it from memory in each run.

    Its sum or difference with an int is a `RowCount` too. Any other arithmetic gives an int, which compiled calls
    refuse as a number of rows during a recording.
    """

    count: Count
    offset: int
    address: int
    capacity: int

    @classmethod
    def of(cls, count: Count, offset: int = 0) -> RowCount:
        """Makes the `RowCount` of a count plus ``offset``; its int value is the number of rows in this run."""
        rows = cls(count.now + offset)
        rows.count, rows.offset, rows.address, rows.capacity = count, offset, count.memory.data_ptr(), count.capacity
        return rows

    @property
    def now(self) -> int:
        """The number of rows in this run."""
        return self.count.now + self.offset

    def __add__(self, offset: Any) -> Any:
        return RowCount.of(self.count, self.offset + offset) if type(offset) is int else int(self) + offset

    def __sub__(self, less: Any) -> Any:
        return self + -less if type(less) is int else int(self) - less


def rows_of(tensor: Tensor) -> int:
    """Returns the number of rows of a tensor."""
    recording = active.recording
    rows: int = tensor.shape[0] if recording is None else recording.rows_of(tensor)
    return rows


def new_empty(like: Tensor, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
    """Allocates memory on a tensor's device; if the rows are a `RowCount`, later runs may have more rows."""
    recording = active.recording
    if recording is None or not (shape and isinstance(shape[0], RowCount)):
        # torch takes longer with a tuple of sizes, and with a dtype.
        sizes: Any = shape or ((),)
        return like.new_empty(*sizes) if dtype is None else like.new_empty(*sizes, dtype=dtype)
    memory: Tensor = recording.new_rows(like, shape, dtype)
    return memory


def new_zeros(like: Tensor, *shape: int) -> Tensor:
    """Allocates memory as :func:`new_empty` does, and fills it with zeros, in each run of a recording."""
    if active.recording is None:
        return like.new_zeros(shape)
    zeros: Tensor = active.recording.zeroed(new_empty(like, *shape))
    return zeros


def read_count(memory: Tensor) -> int:
    """Reads a number of rows that a call has computed, int64 [1]. Replays read it again from this memory."""
    if active.recording is None:
        return int(memory)
    rows: int = active.recording.computed(memory)
    return rows


def fixed_count(rows: int) -> int:
    """Returns ``rows`` as a row count that is the same in every replay."""
    return rows if active.recording is None else active.recording.count(lambda: rows)


def following_count(rows: int, follows: Callable[[int], int]) -> int:
    """Returns ``follows(rows)``, a number of rows that depends on another one. Replays evaluate it again."""
    if not isinstance(rows, RowCount):
        return follows(rows)
    count: int = active.recording.count(lambda: follows(rows.now))
    return count


def varying(value: Callable[[], float]) -> float | Tensor:
    """Returns a number that varies between replays, rounded to float32; in a recording or capture it is a tensor []."""
    return ctypes.c_float(value()).value if active.vary is None else active.vary(value)
