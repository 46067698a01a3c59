"""Recordings: a function's calls of the compiled module are recorded once and replayed without Python.

A recorded function runs normally. The recording keeps each call of the compiled module with its loaded arguments
(csrc/bindings/bind.cpp), and inspects every torch operation. New memory is made large enough for later runs. Random
integers are drawn again in each run. Views need no replay. Pointwise operations (``torch.Tag.pointwise``) are computed
again. Any other torch operation would be missing from a replay, so the function cannot be replayed:
:attr:`Recording.obstacle` names the operation.

A recording holds the storages of all tensors that its calls take. If one of these tensors or its base has moved
(``x.data = y``), :meth:`Recording.replay` makes no calls and returns 0.

All values that vary from run to run lie in memory: numbers of rows (rows.py), other numbers
(:func:`voronerf.ops._core.rows.varying`), random integers, and results of earlier calls. One call of
:meth:`Recording.replay` can make several runs, in which only random integers and results of calls differ. The
memory has room for a quarter more rows than the recorded run; :meth:`Recording.replay` makes no run with more rows.
"""

from __future__ import annotations

import contextlib
import ctypes
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from voronerf.ops._core.active import active
from voronerf.ops._core.modes import run_within
from voronerf.ops._core.rows import Count, RowCount

#: The spare rows of memory: n // SPARE + SOME for a recorded run of n rows.
SPARE, SOME = 4, 64
_NEW = ("aten::new_empty", "aten::empty")
_HARMLESS = ("aten::promote_types", "aten::result_type")
_KINDS = {torch.Tag.pointwise, torch.Tag.nondeterministic_seeded}
_PASSED_OVER = (str(Path(torch.__file__).absolute().parent), str(Path(__file__).absolute()))


class _Memory(NamedTuple):
    """An allocation for the calls: the whole tensor, and the `Count` of its rows if this number can vary."""

    whole: Tensor
    rows: Count | None = None


class _Held(NamedTuple):
    """An object that holds tensors of the recorded run, and its copy with the rows of the last run."""

    recorded: Any
    counts: list[Count]
    rows: list[int]
    value: Any


class _Computed(NamedTuple):
    """A torch operation to repeat after the first ``after`` compiled calls; ``result`` is None if it is in place."""

    after: int
    function: Any
    arguments: Sequence[Any]
    options: dict[str, Any]
    result: Tensor | None


class Recording(TorchDispatchMode):
    """The recorded calls of a function, which runs once: in :meth:`record`, or in a ``with`` block.

    Attributes:
        obstacle: The reason why the calls cannot be replayed; None if they can.

    Args:
        before: The earlier recordings whose memory the function reads.

    Examples:
        >>> import torch
        >>> from voronerf.ops import nearest_centre
        >>> from voronerf.ops._core.recording import Recording
        >>> points, centres = torch.rand(5, 3), torch.rand(4, 3)
        >>> with Recording() as recording:
        ...     cells = nearest_centre(recording.take(points), centres)
        >>> others = torch.rand(6, 3)
        >>> recording.obstacle, recording.replay(threads=1, inputs=[others])
        (None, 1)
        >>> bool((recording.now(cells) == nearest_centre(others, centres)).all())
        True
    """

    def __init__(self, *before: Recording) -> None:
        super().__init__()
        from voronerf.ops._core import native

        self._compiled, self._calls = native.compiled, native.compiled.Recording()
        self._counts = list[Count]()  # numbers of rows that functions return before each replay
        self._numbers = list[tuple[ctypes.c_float, Tensor, Callable[[], float]]]()
        self._drawn, self._computed = list[Tensor](), list[_Computed]()
        self._inputs, self._taken = list[Tensor](), list[Tensor]()  # memory for the inputs, and the inputs of this run
        self._range: tuple[int, int, torch.Generator, torch.dtype, int] | None = None  # arguments of every random draw
        self._memory: dict[int, _Memory] = {}  # by the address of the storage
        for recording in before:
            self._memory |= recording._memory
        held = (recording.rows for recording in self._memory.values() if recording.rows is not None)
        self._rows = {count: count.now for count in held}  # numbers of rows in the recorded run
        self._places: dict[Tensor, RowCount | None] = {}
        self._views: dict[Tensor, Tensor] = {}
        self._held: dict[int, _Held] = {}  # by the id of the object
        self._is_paused = False  # whether torch operations run without an inspection
        self.obstacle: str | None = None

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # torch's method imports the compiler, which takes over a second

    def __enter__(self) -> Recording:
        for address, memory in self._memory.items():
            self._calls.made(address, memory.rows is not None)
        self._calls.begin()
        active.recording, active.vary = self, self.vary
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._end()

    def _end(self) -> None:
        active.recording = active.vary = None
        self._calls.end()
        self._refuse(self._calls.obstacle)

    def record(self, function: Callable[[], Any]) -> Any:
        """Runs a function and records its calls. Unlike ``with``, always stops, even if Ctrl-C interrupts the exit."""
        try:
            return run_within(self, function)
        finally:
            self._end()

    @contextlib.contextmanager
    def _paused(self) -> Iterator[None]:
        """Returns a context in which torch operations run without an inspection."""
        before, self._is_paused = self._is_paused, True
        try:
            yield
        finally:
            self._is_paused = before

    def __len__(self) -> int:
        """Returns the number of recorded calls."""
        return len(self._calls)

    def hold(self, tensor: Tensor) -> None:
        """Watches a tensor that the recording allocated: if the caller replaces its memory, replays are refused."""
        self._calls.hold_tensor(tensor)

    def count(self, source: Callable[[], int]) -> int:
        """Returns the number of rows of this run; each replay first calls ``source`` for its number."""
        with self._paused():
            memory = torch.empty(1, dtype=torch.int64, device="cpu")
        ctypes.c_int64.from_address(memory.data_ptr()).value = source()
        count = self._new_count(memory, source)
        self._counts.append(count)
        return RowCount.of(count)

    def computed(self, memory: Tensor) -> int:
        """Returns the number of rows that a call has written into ``memory``, int64 [1]."""
        if memory.dtype is not torch.int64:  # a number on a GPU: calls on a GPU are not recorded
            self._refuse("a number of rows is not int64")
            return int(memory)
        return RowCount.of(self._new_count(memory, None))

    def _new_count(self, memory: Tensor, source: Callable[[], int] | None) -> Count:
        rows = ctypes.c_int64.from_address(memory.data_ptr()).value
        self._refuse("there are no rows" if rows == 0 else "")
        count = Count(memory, rows + rows // SPARE + SOME, source)
        self._rows[count] = rows
        return count

    def vary(self, value: Callable[[], float]) -> Tensor:
        """Returns the result of ``value`` as float32 []; each replay first calls ``value`` again."""
        with self._paused():
            number = torch.empty((), dtype=torch.float32, device="cpu")
        memory = ctypes.c_float.from_address(number.data_ptr())
        memory.value = value()
        self._numbers.append((memory, number, value))
        return number

    def take(self, tensor: Tensor) -> Tensor:
        """Copies an input of the runs into memory of the recording, and returns this memory; its rows may vary."""
        place = len(self._taken)
        self._taken.append(tensor)  # replaced by the input of each run
        shape = tensor.shape
        if tensor.dim():
            memory = self.new_rows(tensor, (self.count(lambda: len(self._taken[place])), *shape[1:]), None)
        else:
            memory = tensor.new_empty(())
        with self._paused():
            memory.copy_(tensor.detach())
        self._inputs.append(memory)
        return memory

    def new_rows(self, like: Tensor, shape: Sequence[int], dtype: torch.dtype | None) -> Tensor:
        """Allocates memory for a `RowCount` of rows, large enough for the largest number of rows."""
        rows, *columns = shape
        assert isinstance(rows, RowCount)
        with self._paused():
            whole = like.new_empty([rows.capacity + max(rows.offset, 0), *columns], dtype=dtype)
            self._compiled.advise_huge_pages(whole, whole.nbytes)
        self._register(whole, rows.count)
        return whole[: int(rows)]

    def zeroed(self, tensor: Tensor) -> Tensor:
        """Fills a tensor's rows with zeros in each run, and returns the tensor."""
        from voronerf.ops._core import native

        self._compiled.zero_rows(tensor, tensor[:1].numel(), self.rows_of(tensor), native.cpu())
        return tensor

    def _register(self, whole: Tensor, count: Count | None = None) -> Tensor:
        address = whole.untyped_storage().data_ptr()
        self._memory[address] = _Memory(whole, count)
        self._calls.made(address, count is not None)
        return whole

    def _refuse(self, reason: str) -> None:
        self.obstacle = self.obstacle or reason or None

    def replay(self, threads: int, times: int = 1, inputs: Sequence[Tensor] = ()) -> int:
        """Makes the recorded calls again.

        Args:
            threads: The number of threads of the calls.
            times: The number of runs.
            inputs: The inputs of these runs, one for each call of :meth:`take`.

        Returns:
            The number of completed runs: fewer than ``times`` if memory is too small for the rows, 0 if a tensor moved.

        Raises:
            ValueError: A call has found an invalid value in its arguments.
        """
        if not self._calls.hold():
            return 0
        self._taken[:] = inputs
        for count in self._counts:
            rows = count.read()  # type: ignore[misc]
            if not 0 < rows <= count.capacity:
                return 0
            count.now = rows
        for number, _, value in self._numbers:
            number.value = value()
        for memory, tensor in zip(self._inputs, inputs, strict=True):
            self._tensor_now(memory).copy_(tensor.detach())
        if self._range is None:
            return self._run(threads, times, 0, [], 0)
        low, high, generator, dtype, size = self._range
        state = generator.get_state()
        drawn = torch.empty(times, len(self._drawn), size, dtype=dtype, device="cpu")
        drawn.random_(low, high, generator=generator)
        places = [integers.data_ptr() for integers in self._drawn]
        completed = self._run(threads, times, drawn.data_ptr(), places, size * drawn.element_size())
        if completed < times:  # the next replay draws the integers of the remaining runs again
            generator.set_state(state)
            drawn[:completed].random_(low, high, generator=generator)
        return completed

    def _run(self, threads: int, times: int, drawn: int, places: Sequence[int], size: int) -> int:
        """Runs the calls and torch operations in order, and returns the number of completed runs.

        Args:
            threads: The number of threads of the calls.
            times: The number of runs.
            drawn: The address of the random integers for all runs.
            places: The addresses of the arrays that receive random integers in each run.
            size: The bytes of one of these arrays.
        """
        calls, every = self._calls, len(self._calls)
        if not self._computed:
            completed: int = calls.replay(threads, times, 0, every, drawn, places, size)
            return completed
        for run in range(times):
            first, new = 0, places
            for op in self._computed:
                if (new or op.after > first) and not calls.replay(threads, 1, first, op.after, drawn, new, size):
                    return run
                arguments = [self.now(argument) for argument in op.arguments]
                result = op.function(*arguments, **{name: self.now(value) for name, value in op.options.items()})
                if op.result is not None:
                    self._tensor_now(op.result).copy_(result)
                first, new = op.after, []
            if not calls.replay(threads, 1, first, every, 0, [], 0):
                return run
            drawn += len(places) * size
        return times

    def rows_of(self, tensor: Tensor) -> int:
        """Returns the number of rows of a tensor, as a `RowCount` if it can vary."""
        place = self._place(tensor)
        return tensor.shape[0] if place is None else place

    def now(self, recorded: Any) -> Any:
        """Returns an object of the recorded run, with all its tensors resized to the rows of the last run."""
        if isinstance(recorded, Tensor):
            return self._tensor_now(recorded)
        if isinstance(recorded, RowCount):
            return recorded.now
        entries = entries_of(recorded)
        if not entries:
            return recorded
        held = self._held.get(id(recorded))
        if held is None:
            held = self._held[id(recorded)] = _Held(recorded, self._counts_of(recorded), [], recorded)
        rows = [count.now for count in held.counts]
        if rows != held.rows:
            held = self._held[id(recorded)] = held._replace(rows=rows, value=mapped(self.now, recorded))
        return held.value

    def counted_now(self, recorded: Any) -> Any:
        """Returns an object as :meth:`now` does, for use in another recording: numbers of rows remain `RowCount`."""
        if isinstance(recorded, RowCount):
            return RowCount.of(recorded.count, recorded.offset)
        return self._tensor_now(recorded) if isinstance(recorded, Tensor) else mapped(self.counted_now, recorded)

    def _counts_of(self, recorded: Any) -> list[Count]:
        """Returns the distinct counts of the rows of all tensors in an object."""
        if isinstance(recorded, (RowCount, Tensor)):
            place = recorded if isinstance(recorded, RowCount) else self._place(recorded)
            return [] if place is None else [place.count]
        return [*dict.fromkeys(count for entry in entries_of(recorded) or () for count in self._counts_of(entry))]

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
        """Returns the number of a tensor's rows, or None if it is constant."""
        held = self._memory.get(tensor.untyped_storage().data_ptr())
        if held is None or held.rows is None or not tensor.dim() or tensor.stride(0) != held.whole.stride(0):
            return None
        more = tensor.shape[0] - self._rows[held.rows]
        return RowCount.of(held.rows, more) if abs(more) <= 1 else None

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Inspects each torch operation of the recorded function."""
        name, kwargs = func._schema.name, kwargs or {}
        result = func(*args, **kwargs)
        if self._is_paused:
            return result
        if name in _NEW:
            if name == "aten::new_empty" and self._place(args[0]) is not None and [*args[1][:1]] == [len(args[0])]:
                self._refuse(f"memory of {len(args[0])} rows was allocated without a RowCount{_line()}")
            return self._register(result)
        if func.is_view:
            self._calls.add_tensor(args[0])  # a view would keep the old memory if its base moved
            if isinstance(result, Tensor) and (held := self._memory.get(result.untyped_storage().data_ptr())):
                moved = result.storage_offset() - held.whole.storage_offset()
                if held.rows is not None and moved >= held.whole.stride(0):
                    self._refuse(f"a slice of a step's rows is read{_line()}")
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
        """Records a pointwise operation, to be computed again in place or into its result's memory."""
        rows = None
        for tensor in (each for each in (*args, *kwargs.values()) if isinstance(each, Tensor)):
            self._calls.add_tensor(tensor)
            held = self._memory.get(tensor.untyped_storage().data_ptr())
            if held is not None and held.rows is not None and tensor.dim():
                rows = self._place(tensor)
                if rows is None or tensor.dim() != result.dim():
                    self._refuse(f"torch broadcasts a step's rows as columns{_line()}")
                    return result
        memory = None
        if not func._schema.is_mutable:
            memory = self._register(result) if rows is None else self.new_rows(result, (rows, *result.shape[1:]), None)
            if memory is not result:
                with self._paused():
                    memory.copy_(result)
        self._computed.append(_Computed(len(self._calls), func, args, kwargs, memory))
        return result if memory is None else memory


def mapped(function: Callable[[Any], Any], tree: Any) -> Any:
    """Applies a function to the entries of a tuple, list, dictionary or dataclass; returns other objects unchanged."""
    if isinstance(tree, (list, tuple)):
        entries = map(function, tree)
        return type(tree)(*entries) if hasattr(tree, "_fields") else type(tree)(entries)
    if isinstance(tree, dict):
        return {name: function(value) for name, value in tree.items()}
    if names := _field_names(tree):
        return type(tree)(**{name: function(getattr(tree, name)) for name in names})
    return tree


def entries_of(tree: Any) -> list[Any] | None:
    """Returns the entries to which `mapped` applies its function, or None for an object without entries."""
    if isinstance(tree, (list, tuple)):
        return [*tree]
    if isinstance(tree, dict):
        return [*tree.values()]
    return [getattr(tree, name) for name in names] if (names := _field_names(tree)) else None


def _field_names(tree: Any) -> list[str]:
    return [] if isinstance(tree, type) else [*getattr(tree, "__dataclass_fields__", ())]


def _line() -> str:
    """Returns the source line, in the package or its caller, that runs a torch operation."""
    for frame, line in traceback.walk_stack(sys._getframe()):
        file = frame.f_code.co_filename
        if not file.startswith(_PASSED_OVER):
            return f", in {Path(file).name}:{line}"
    return ""
