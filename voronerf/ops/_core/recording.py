"""Compiled calls that are recorded once and made again, without Python in between.

While a function is recorded, it runs as ever. Each of its calls of the compiled module is kept with what it has loaded
(csrc/bindings/bind.cpp), and everything that it asks of torch is looked at: new memory is made large enough for later
runs, random integers are drawn again for each of them, views change nothing, and what torch computes entry by entry
(``torch.Tag.pointwise``) is computed again. Whatever else torch computes would be missing later, so it keeps the
function from being replayed: :attr:`Recording.obstacle` says what it is.

A recording holds the storages of all tensors that its calls take. Where one of these tensors, or one that they are
views of, has moved (``x.data = y``), the calls are not made: :meth:`Recording.replay` says so.

What changes lies in memory: numbers of rows (rows.py), other numbers (:func:`voronerf.ops._core.rows.varying`), random
integers, and what earlier calls have computed. Several runs can be made in one call; between them only random integers
change, and what calls compute. There is memory for a quarter more rows than the recorded run had. A run that would
exceed it is not made: :meth:`Recording.replay` says so.
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
from voronerf.ops._core.rows import Count, RowCount

#: Rows that there is memory for, beside those of the recorded run: one for so many, and some.
SPARE, SOME = 4, 64
_NEW = ("aten::new_empty", "aten::empty")
_HARMLESS = ("aten::promote_types", "aten::result_type")
_KINDS = {torch.Tag.pointwise, torch.Tag.nondeterministic_seeded}
_PASSED_OVER = (str(Path(torch.__file__).absolute().parent), str(Path(__file__).absolute()))


class _Memory(NamedTuple):
    """Memory that was made for the calls: all of it, and the number of its rows if there can be more of them."""

    whole: Tensor
    rows: Count | None = None


class _Held(NamedTuple):
    """Something that holds tensors of the recorded run, and the same with as many rows as it last had."""

    found: Any
    counts: list[Count]
    rows: list[int]
    value: Any


class _Computed(NamedTuple):
    """What torch computes again, after so many of the compiled calls, and where its result lies; None for in place."""

    after: int
    function: Any
    arguments: Sequence[Any]
    options: dict[str, Any]
    result: Tensor | None


class Recording(TorchDispatchMode):
    """The compiled calls of a function; a context around the function, to be entered once.

    Attributes:
        obstacle: Why they cannot be made again; None if they can.

    Args:
        before: Recordings whose memory the function reads.

    Examples:
        >>> import torch
        >>> from voronerf.ops import nearest_centre
        >>> from voronerf.ops._core.recording import Recording
        >>> points, centres = torch.rand(5, 3), torch.rand(4, 3)
        >>> with Recording() as recording:
        ...     cells = nearest_centre(recording.take(points), centres)
        >>> others = torch.rand(6, 3)
        >>> recording.obstacle, recording.replay(threads=1, taken=[others])
        (None, 1)
        >>> bool((recording.now(cells) == nearest_centre(others, centres)).all())
        True
    """

    def __init__(self, *before: Recording) -> None:
        super().__init__()
        from voronerf.ops._core import native

        self._compiled, self._calls = native.compiled, native.compiled.Recording()
        self._counts = list[Count]()  # that are given
        self._numbers = list[tuple[ctypes.c_float, Tensor, Callable[[], float]]]()
        self._drawn, self._computed = list[Tensor](), list[_Computed]()
        self._inputs, self._taken = list[Tensor](), list[Tensor]()  # memory for what is taken, and that of this run
        self._range: tuple[int, int, torch.Generator, torch.dtype, int] | None = None  # that all are drawn from
        self._memory: dict[int, _Memory] = {}  # by address
        for each in before:
            self._memory |= each._memory
        held = (each.rows for each in self._memory.values() if each.rows is not None)
        self._rows = {count: count.now for count in held}  # of the recorded run
        self._places: dict[Tensor, RowCount | None] = {}
        self._views: dict[Tensor, Tensor] = {}
        self._held: dict[int, _Held] = {}  # by id
        self.obstacle: str | None = None

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # torch's own imports its compiler, to keep it off this class, which takes over a second

    def __enter__(self) -> Recording:
        for address, each in self._memory.items():
            self._calls.made(address, each.rows is not None)
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
        """How many compiled calls are made again."""
        return len(self._calls)

    def hold(self, tensor: Tensor) -> None:
        """Makes no calls any more where a tensor has moved that was made for them, as others may give it memory."""
        self._calls.hold_tensor(tensor)

    def count(self, given: Callable[[], int]) -> int:
        """A number of rows that is known before each run; that of this one."""
        with _disable_current_modes():
            count = self._new_count(torch.tensor([given()]), given)
        self._counts.append(count)
        return RowCount.of(count)

    def computed(self, memory: Tensor) -> int:
        """A number of rows that a call has computed, int64 [1]."""
        with _disable_current_modes():
            if memory.dtype is not torch.int64:  # of a device, whose calls are not recorded
                self._refuse("a number of rows is no int64")
                return int(memory)
            return RowCount.of(self._new_count(memory, None))

    def _new_count(self, memory: Tensor, given: Callable[[], int] | None) -> Count:
        rows = int(memory)
        self._refuse("there are no rows" if rows == 0 else "")
        count = Count(memory, rows + rows // SPARE + SOME, given)
        self._rows[count] = rows
        return count

    def vary(self, value: Callable[[], float]) -> Tensor:
        """A number that changes from run to run, float32 []."""
        with _disable_current_modes():
            number = torch.tensor(value(), dtype=torch.float32)
        self._numbers.append((ctypes.c_float.from_address(number.data_ptr()), number, value))
        return number

    def take(self, given: Tensor) -> Tensor:
        """Memory for a tensor that each run is given, with as many rows as it then has; it holds that of this run."""
        place = len(self._taken)
        self._taken.append(given)  # and then that of each run
        shape = given.shape
        if given.dim():
            memory = self.new_rows(given, (self.count(lambda: len(self._taken[place])), *shape[1:]), None)
        else:
            memory = given.new_empty(())
        with _disable_current_modes():
            memory.copy_(given.detach())
        self._inputs.append(memory)
        return memory

    def new_rows(self, like: Tensor, shape: Sequence[int], dtype: torch.dtype | None) -> Tensor:
        """New memory whose rows are a `RowCount`; there is some for the most of them."""
        rows, *columns = shape
        assert isinstance(rows, RowCount)
        with _disable_current_modes():
            whole = like.new_empty([rows.most + max(rows.more, 0), *columns], dtype=dtype)
            self._compiled.advise_huge_pages(whole, whole.nbytes)
        self._made(whole, rows.count)
        return whole[: int(rows)]

    def _made(self, whole: Tensor, count: Count | None = None) -> Tensor:
        address = whole.untyped_storage().data_ptr()
        self._memory[address] = _Memory(whole, count)
        self._calls.made(address, count is not None)
        return whole

    def _refuse(self, why: str) -> None:
        self.obstacle = self.obstacle or why or None

    def replay(self, threads: int, times: int = 1, taken: Sequence[Tensor] = ()) -> int:
        """Makes the calls again.

        Args:
            threads: Of the calls.
            times: How often, in a row.
            taken: In the place of what :meth:`take` was given, for this run.

        Returns:
            How often they were made: less where there is no memory for the rows, 0 where a tensor has moved.

        Raises:
            ValueError: As of the calls, for what they find in their arguments.
        """
        if not self._calls.hold():
            return 0
        self._taken[:] = taken
        for count in self._counts:
            rows = count.given()  # type: ignore[misc]
            if not 0 < rows <= count.most:
                return 0
            count.now = rows
        for number, _, value in self._numbers:
            number.value = value()
        for memory, given in zip(self._inputs, taken, strict=True):
            self._tensor_now(memory).copy_(given.detach())
        if self._range is None:
            return self._run(threads, times, 0, [], 0)
        low, high, generator, dtype, size = self._range
        before, drawn = generator.get_state(), torch.empty(times, len(self._drawn), size, dtype=dtype)
        drawn.random_(low, high, generator=generator)
        places = [each.data_ptr() for each in self._drawn]
        made = self._run(threads, times, drawn.data_ptr(), places, size * drawn.element_size())
        if made < times:  # what follows draws the others again
            generator.set_state(before)
            drawn[:made].random_(low, high, generator=generator)
        return made

    def _run(self, threads: int, times: int, drawn: int, places: Sequence[int], size: int) -> int:
        """Makes the calls, and what torch computes in between; there are random integers of so many bytes for them."""
        calls, every = self._calls, len(self._calls)
        if not self._computed:
            made: int = calls.replay(threads, times, 0, every, drawn, places, size)
            return made
        for run in range(times):
            first, new = 0, places
            for each in self._computed:
                if (new or each.after > first) and not calls.replay(threads, 1, first, each.after, drawn, new, size):
                    return run
                arguments = [self.now(argument) for argument in each.arguments]
                result = each.function(*arguments, **{name: self.now(value) for name, value in each.options.items()})
                if each.result is not None:
                    self._tensor_now(each.result).copy_(result)
                first, new = each.after, []
            if not calls.replay(threads, 1, first, every, 0, [], 0):
                return run
            drawn += len(places) * size
        return times

    def rows_of(self, tensor: Tensor) -> int:
        """How many rows a tensor has: a `RowCount` where there can be more of them."""
        place = self._place(tensor)
        return tensor.shape[0] if place is None else place

    def now(self, found: Any) -> Any:
        """Tensors of the recorded run, in whatever holds them, with as many rows as the last run has filled."""
        if isinstance(found, Tensor):
            return self._tensor_now(found)
        if isinstance(found, RowCount):
            return found.now
        entries = entries_of(found)
        if not entries:
            return found
        held = self._held.get(id(found))
        if held is None:
            held = self._held[id(found)] = _Held(found, self._counts_of(found), [], found)
        rows = [count.now for count in held.counts]
        if rows != held.rows:
            held = self._held[id(found)] = held._replace(rows=rows, value=mapped(self.now, found))
        return held.value

    def counted_now(self, found: Any) -> Any:
        """As :meth:`now`, for another recording, which reads numbers of rows again, too."""
        if isinstance(found, RowCount):
            return RowCount.of(found.count, found.more)
        return self._tensor_now(found) if isinstance(found, Tensor) else mapped(self.counted_now, found)

    def _counts_of(self, found: Any) -> list[Count]:
        """The numbers of rows that tensors have, in whatever holds them."""
        if isinstance(found, (RowCount, Tensor)):
            place = found if isinstance(found, RowCount) else self._place(found)
            return [] if place is None else [place.count]
        return [*dict.fromkeys(count for each in entries_of(found) or () for count in self._counts_of(each))]

    def _tensor_now(self, tensor: Tensor) -> Tensor:
        if tensor not in self._places:
            self._places[tensor], self._views[tensor] = self._place(tensor), tensor
        place, view = self._places[tensor], self._views[tensor]
        if place is None or len(view) == place.now:
            return view
        size = place.now, *tensor.shape[1:]
        view = self._views[tensor] = tensor.as_strided(size, tensor.stride(), tensor.storage_offset())
        return view

    def _place(self, tensor: Tensor) -> RowCount | None:
        """The number of a tensor's rows; None for one that stays."""
        held = self._memory.get(tensor.untyped_storage().data_ptr())
        if held is None or held.rows is None or not tensor.dim() or tensor.stride(0) != held.whole.stride(0):
            return None
        more = tensor.shape[0] - self._rows[held.rows]
        return RowCount.of(held.rows, more) if abs(more) <= 1 else None

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """What torch is asked while a function is recorded."""
        name, kwargs = func._schema.name, kwargs or {}
        result = func(*args, **kwargs)
        if name in _NEW:
            if name == "aten::new_empty" and self._place(args[0]) is not None and [*args[1][:1]] == [len(args[0])]:
                self._refuse(f"new memory of {len(args[0])} rows is not counted{_line()}")
            return self._made(result)
        if func.is_view:
            self._calls.add_tensor(args[0])  # a view of it would stay where it was
            if isinstance(result, Tensor) and (held := self._memory.get(result.untyped_storage().data_ptr())):
                moved = result.storage_offset() - held.whole.storage_offset()
                if held.rows is not None and moved >= held.whole.stride(0):
                    self._refuse(f"a part of the rows of a step is read{_line()}")
        elif name == "aten::randint" and len(args) == 3 and kwargs.get("generator") is not None:
            self._drawn.append(result)
            drawn_from = (args[0], args[1], kwargs["generator"], result.dtype, result.numel())
            if self._range not in (None, drawn_from):
                self._refuse("random integers of two kinds are drawn")
            self._range = drawn_from
        elif isinstance(result, Tensor) and {torch.Tag.pointwise} == _KINDS.intersection(func.tags):
            return self._compute(func, args, kwargs, result)
        elif name not in _HARMLESS and not name.startswith("profiler::"):
            self._refuse(f"torch computes {name.split('::')[-1]}{_line()}")
        return result

    def _compute(self, func: Any, args: Any, kwargs: Any, result: Tensor) -> Tensor:
        """What torch computes entry by entry: in place, or in memory where it is computed again."""
        rows = None
        for tensor in (each for each in (*args, *kwargs.values()) if isinstance(each, Tensor)):
            self._calls.add_tensor(tensor)
            held = self._memory.get(tensor.untyped_storage().data_ptr())
            if held is not None and held.rows is not None and tensor.dim():
                rows = self._place(tensor)
                if rows is None or tensor.dim() != result.dim():
                    self._refuse(f"torch takes the rows of a step for columns{_line()}")
                    return result
        memory = None
        if not func._schema.is_mutable:
            memory = self._made(result) if rows is None else self.new_rows(result, (rows, *result.shape[1:]), None)
            if memory is not result:
                with _disable_current_modes():
                    memory.copy_(result)
        self._computed.append(_Computed(len(self._calls), func, args, kwargs, memory))
        return result if memory is None else memory


def mapped(function: Callable[[Any], Any], held: Any) -> Any:
    """The same tuple, list, dictionary or dataclass of what a function gives for its entries; all else as it is."""
    if isinstance(held, (list, tuple)):
        own = map(function, held)
        return type(held)(*own) if hasattr(held, "_fields") else type(held)(own)
    if isinstance(held, dict):
        return {name: function(value) for name, value in held.items()}
    if hasattr(held, "__dataclass_fields__"):
        return type(held)(**{name: function(value) for name, value in vars(held).items()})
    return held


def entries_of(held: Any) -> list[Any] | None:
    """What `mapped` gives to its function; None for what has no entries."""
    if isinstance(held, (list, tuple)):
        return [*held]
    known = held if isinstance(held, dict) else vars(held) if hasattr(held, "__dataclass_fields__") else None
    return None if known is None else [*known.values()]


def _line() -> str:
    """Where the package, or its caller, is."""
    for frame, line in traceback.walk_stack(sys._getframe()):
        file = frame.f_code.co_filename
        if not file.startswith(_PASSED_OVER):
            return f", in {Path(file).name}:{line}"
    return ""
