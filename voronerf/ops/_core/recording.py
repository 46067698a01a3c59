"""Calls of the compiled module that are recorded once and made again by one call, without Python in between.

While a function is recorded, it runs as ever. Each of its calls of the compiled module is kept with what it has loaded
(csrc/bindings/bind.cpp), and everything that it asks of torch is looked at: new memory is made large enough for later
runs, random integers are drawn again for each of them, and views change nothing. Whatever else torch computes
would be missing later, so it keeps the function from being replayed: :attr:`Recording.obstacle` says what it is.

A recording holds the storages of all tensors that its calls take. Where one of these tensors, or one that they are
views of, has moved (``x.data = y``), the calls are not made: :meth:`Recording.replay` says so.

What changes lies in memory: numbers of rows (:meth:`Recording.count`, :func:`read_count`), other numbers
(:func:`varying`), random integers, and what earlier calls have computed. Several runs can be made in one call; between
them only random integers change, and what calls compute. There is memory for a quarter more rows than the
recorded run had. A run that would exceed it is not made: :meth:`Recording.replay` says so.
"""

from __future__ import annotations

import ctypes
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from voronerf.ops._core.active import active

#: Rows that there is memory for, beside those of the recorded run: one for so many, and some.
SPARE, SOME = 4, 64
_NEW = ("aten::new_empty", "aten::empty")
_HARMLESS = ("aten::promote_types", "aten::result_type")
_PASSED_OVER = (str(Path(torch.__file__).absolute().parent), str(Path(__file__).absolute()))


class Count(NamedTuple):
    """A number of rows.

    Attributes:
        memory: int64 [1], where it lies.
        rows: What it was when it was recorded.
        most: What there is memory for.
        given: What gives it before each run; None for one that a call computes.
    """

    memory: Tensor
    rows: int
    most: int
    given: Callable[[], int] | None


class Recording(TorchDispatchMode):
    """The compiled calls of a function; a context around the function, to be entered once.

    Attributes:
        obstacle: Why they cannot be made again; None if they can.

    Examples:
        >>> import torch
        >>> from voronerf.ops import nearest_centre
        >>> from voronerf.ops._core.recording import Recording
        >>> points, centres = torch.rand(5, 3), torch.rand(4, 3)
        >>> with Recording() as recording:
        ...     rows = recording.count(lambda: 5)
        ...     cells = nearest_centre(points, centres)
        >>> _ = points.copy_(torch.rand(5, 3))
        >>> recording.obstacle, recording.replay(threads=1)
        (None, 1)
        >>> bool((cells == nearest_centre(points, centres)).all())
        True
    """

    def __init__(self) -> None:
        super().__init__()
        from voronerf.ops._core import native

        self._compiled, self._calls = native.compiled, native.compiled.Recording()
        self._counts = list[Count]()
        self._numbers = list[tuple[Tensor, Callable[[], float]]]()
        self._drawn, self._taken = list[Tensor](), list[Tensor]()
        self._range: tuple[int, int, torch.Generator, torch.dtype, int] | None = None  # that all are drawn from
        self._memory: dict[int, Tensor] = {}  # of rows, by address
        self._places: dict[Tensor, tuple[Tensor, int] | None] = {}
        self.obstacle: str | None = None

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # torch's own imports its compiler, to keep it off this class, which takes over a second

    def __enter__(self) -> Recording:
        self._calls.begin()
        active.recording, active.vary = self, self.vary
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        active.recording = active.vary = None
        self._calls.end()
        self._refuse(self._calls.obstacle)

    def __len__(self) -> int:
        """How many calls are made again."""
        return len(self._calls)

    def count(self, given: Callable[[], int]) -> int:
        """A number of rows that is known before each run; that of this one."""
        with _disable_current_modes():
            rows = given()
            self._add(torch.tensor([rows]), rows, given)
        return rows

    def vary(self, value: Callable[[], float]) -> Tensor:
        """A number that changes from run to run, float32 []."""
        with _disable_current_modes():
            number = torch.tensor(value(), dtype=torch.float32)
        self._numbers.append((number, value))
        return number

    def take(self, given: Tensor) -> Tensor:
        """Memory for a tensor that each run is given, with rows that were counted; it holds that of this run."""
        memory = given.new_empty(given.shape)
        with _disable_current_modes():
            memory.copy_(given)
        self._taken.append(self._memory.get(memory.untyped_storage().data_ptr(), memory))  # for the most rows
        return memory

    def _add(self, memory: Tensor, rows: int, given: Callable[[], int] | None) -> None:
        if any(abs(rows - other.rows) <= 1 for other in self._counts):  # a tensor has one more of them, or not
            self._refuse(f"two numbers of rows are much the same, {rows}")
        most = rows + rows // SPARE + SOME
        self._calls.count(memory, most)
        self._counts.append(Count(memory, rows, most, given))
        self._refuse("there are no rows" if rows == 0 else "")

    def _refuse(self, why: str) -> None:
        self.obstacle = self.obstacle or why or None

    def replay(self, threads: int, times: int = 1, taken: Sequence[Tensor] = ()) -> int:
        """Makes the calls again.

        Args:
            threads: Of the calls.
            times: How often, in a row.
            taken: What :meth:`take` was given, for this run.

        Returns:
            How often they were made: less where there is no memory for the rows, 0 where a tensor has moved.

        Raises:
            ValueError: As of the calls, for what they find in their arguments.
        """
        for count in self._counts:
            if count.given is not None:
                rows = count.given()
                if not 0 < rows <= count.most:
                    return 0
                count.memory.fill_(rows)
        for number, value in self._numbers:
            number.fill_(value())
        for memory, given in zip(self._taken, taken, strict=True):
            (memory[: len(given)] if given.dim() else memory).copy_(given)
        if self._range is None:
            return self._calls.replay(threads, times, 0, [], 0)
        low, high, generator, dtype, size = self._range
        before, drawn = generator.get_state(), torch.empty(times, len(self._drawn), size, dtype=dtype)
        drawn.random_(low, high, generator=generator)
        places = [each.data_ptr() for each in self._drawn]
        made: int = self._calls.replay(threads, times, drawn.data_ptr(), places, size * drawn.element_size())
        if made < times:  # what follows draws the others again
            generator.set_state(before)
            drawn[:made].random_(low, high, generator=generator)
        return made

    def rows(self, place: int) -> int:
        """A number of rows of the last run; they are numbered in the order of the recorded one."""
        return int(self._counts[place].memory)

    def rows_of(self, tensor: Tensor) -> int:
        """How many rows of a tensor of the recorded run the last run has filled."""
        for memory, rows, _, _ in self._counts:
            if tensor.shape[0] == rows:
                return int(memory)
        return tensor.shape[0]

    def now(self, found: Any) -> Any:
        """Tensors of the recorded run, in whatever holds them, with as many rows as the last run has filled."""
        if isinstance(found, Tensor):
            return self._tensor_now(found)
        if isinstance(found, (list, tuple)):
            own = map(self.now, found)
            return type(found)(*own) if hasattr(found, "_fields") else type(found)(own)
        if hasattr(found, "__dataclass_fields__"):
            return type(found)(**{name: self.now(value) for name, value in vars(found).items()})
        return found

    def _tensor_now(self, tensor: Tensor) -> Tensor:
        if tensor not in self._places:
            self._places[tensor] = self._place(tensor)
        place = self._places[tensor]
        if place is None:
            return tensor
        memory, more = place
        return tensor.as_strided((int(memory) + more, *tensor.shape[1:]), tensor.stride(), tensor.storage_offset())

    def _place(self, tensor: Tensor) -> tuple[Tensor, int] | None:
        """Where the number of its rows lies, and how many more it has; None for a number that stays."""
        for memory, rows, _, _ in self._counts if self._is_counted(tensor) else ():
            for more in (0, 1):
                if tensor.shape[:1] == (rows + more,):
                    return memory, more
        return None

    def _is_counted(self, tensor: Tensor) -> bool:
        return tensor.untyped_storage().data_ptr() in self._memory

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """What torch is asked while a function is recorded."""
        name, kwargs = func._schema.name, kwargs or {}
        if name in _NEW:
            return self._new(func, [*args], kwargs, args[0] if name == "aten::empty" else args[1])
        result = func(*args, **kwargs)
        if func.is_view:
            self._calls.add_tensor(args[0])  # a view of it would stay where it was
            moved = isinstance(result, Tensor) and result.storage_offset() != args[0].storage_offset()
            if moved and self._is_counted(result):
                self._refuse(f"a part of the rows of a step is read{_line()}")
        elif name == "aten::randint" and len(args) == 3 and kwargs.get("generator") is not None:
            self._drawn.append(result)
            drawn_from = (args[0], args[1], kwargs["generator"], result.dtype, result.numel())
            if self._range not in (None, drawn_from):
                self._refuse("random integers of two kinds are drawn")
            self._range = drawn_from
        elif name not in _HARMLESS and not name.startswith("profiler::"):
            self._refuse(f"torch computes {name.split('::')[-1]}{_line()}")
        return result

    def _new(self, func: Any, args: list[Any], kwargs: Any, size: Any) -> Tensor:
        """New memory; that of rows does for the most of them."""
        for _, rows, most, _ in self._counts:
            for more in (0, 1):
                if len(size) and size[0] == rows + more:
                    args[args.index(size)] = [most + more, *size[1:]]
                    memory: Tensor = func(*args, **kwargs)
                    self._compiled.advise_huge_pages(memory, memory.nbytes)
                    address = memory.untyped_storage().data_ptr()
                    self._memory[address] = memory
                    self._calls.made(address)
                    return memory[: rows + more]
        found: Tensor = func(*args, **kwargs)
        self._calls.made(found.untyped_storage().data_ptr())
        return found


def read_count(memory: Tensor) -> int:
    """A number of rows that a call has computed, int64 [1]. Replays read it again from there."""
    recording = active.recording
    if recording is None:
        return int(memory)
    with _disable_current_modes():
        rows = int(memory)
    recording._add(memory, rows, None)
    return rows


def fixed_count(rows: int) -> int:
    """A number of rows that is the same in each run."""
    return rows if active.recording is None else active.recording.count(lambda: rows)


def following_count(rows: int, follows: Callable[[int], int]) -> int:
    """A number of rows that follows from another one. Replays find it again."""
    recording = active.recording
    if recording is not None:
        of = next((count for count in recording._counts if count.rows == rows), None)
        if of is not None:
            return recording.count(lambda: follows(int(of.memory)))
    return follows(rows)


def varying(value: Callable[[], float]) -> float | Tensor:
    """A number that changes from run to run, rounded to float32. While it is recorded it is a tensor [] for replays."""
    return ctypes.c_float(value()).value if active.vary is None else active.vary(value)


def _line() -> str:
    """Where the package, or its caller, is."""
    for frame, line in traceback.walk_stack(sys._getframe()):
        file = frame.f_code.co_filename
        if not file.startswith(_PASSED_OVER):
            return f", in {Path(file).name}:{line}"
    return ""
