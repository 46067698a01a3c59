"""Segments of a training step: their compiled calls are recorded once and replayed, with Python hooks in between."""

from __future__ import annotations

import dis
import functools
import inspect
import itertools
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.recording import Recording, entries_of, mapped

T = TypeVar("T", bound=type)

#: The maximum number of eager calls after a recording that could not be replayed. The number is 0 after the first such
#: recording and 1 after the second, and then doubles.
MAX_BACKOFF = 64
_REPLAYED = set[type]()
_HARMLESS = {
    *("__dict__", "__weakref__", "__init__", "__init_subclass__", "__class_getitem__"),
    *("__repr__", "__str__", "__eq__", "__hash__", "__reduce__", "__getstate__", "__setstate__"),
}


def replayed(kind: T) -> T:
    """Marks a class whose hooks a :class:`TrainingStep` may record and replay instead of calling them.

    Its methods must compute only with ops and elementwise functions of torch, and data that changes from step to step
    must lie in tensors. Other Python code runs only once, while the step is recorded. All classes of this package are
    marked. If an unmarked subclass overrides a hook, this hook runs in Python in each step. If it overrides another
    member that hooks may use, all its hooks run in Python in each step. A step detects changes of instance
    attributes, but not of class attributes.

    Examples:
        >>> from voronerf.nerf import SplitStrategy, replayed
        >>> @replayed
        ... class Twice(SplitStrategy):  # keeps the samples of a step two times over
        ...     def step_post_backward(self, output):
        ...         super().step_post_backward(output)
        ...         super().step_post_backward(output)
    """
    _REPLAYED.add(kind)
    _overrides.cache_clear()
    _names_read.cache_clear()
    return kind


def in_python(part: Any, hook: str = "") -> bool:
    """Returns whether a hook of an object must be called in each step instead of being replayed.

    Args:
        part: The object.
        hook: The name of the hook; "" asks whether this is true of any hook of the object.
    """
    kind: Any = type(part)
    return hook in getattr(part, "__dict__", ()) or _overrides(kind, hook)


@functools.lru_cache(maxsize=256)
def _overrides(kind: Any, hook: str) -> bool:
    """Returns whether a class overrides a hook of a `replayed` class, or another member that this hook may use."""
    replayed_base = next((base for base in kind.__mro__ if base in _REPLAYED), None)
    if replayed_base is None:
        return True
    protocol, names = [base for base in kind.__mro__ if base in _REPLAYED][-1], _names_read(kind)
    subclasses = kind.__mro__[: kind.__mro__.index(protocol)]
    members = [each for base in subclasses if base not in _REPLAYED for each in vars(base).items()]
    behaviour = {name for name, value in members if callable(value) or hasattr(value, "__get__")}
    overridden = {
        name for name in behaviour - _HARMLESS if hasattr(replayed_base, name) or name in names or name == "__getattr__"
    }
    return hook in overridden or any(not hook or not callable(getattr(protocol, name, None)) for name in overridden)


def free_names(part: Any) -> list[str]:
    """Returns the attributes of an object that no `replayed` class reads, so they may change from step to step."""
    kind: Any = type(part)
    names_read = _names_read(kind)
    return [name for name in vars(part) if name not in names_read]


@functools.lru_cache(maxsize=256)
def _names_read(kind: Any) -> frozenset[str]:
    """Returns the attributes of `self` that the `replayed` classes among a class and its bases use."""
    names, codes = set[str](), list[types.CodeType]()
    for base in filter(_REPLAYED.__contains__, kind.__mro__):
        for value in vars(base).values():
            functions = (value.fget, value.fset) if isinstance(value, property) else (inspect.unwrap(value),)
            codes += [each.__code__ for each in functions if inspect.isfunction(each)]
    while codes:
        code = codes.pop()
        for previous, instruction in itertools.pairwise(dis.get_instructions(code)):
            of_self = previous.argrepr.rpartition(", ")[2] == "self"  # newer Pythons load two names in one instruction
            if of_self and instruction.opname in ("LOAD_ATTR", "LOAD_METHOD", "STORE_ATTR"):
                names.add(instruction.argval)
        codes += [each for each in code.co_consts if inspect.iscode(each)]
    return frozenset(names)


class Stage(NamedTuple):
    """A stage of a training step.

    Attributes:
        name: The name of the stage in :meth:`TrainingStep.explain`.
        function: Function from results of earlier stages to new results by name, or to None.
        reads: The names of the results that the function takes.
        python: Whether the function is called in each step; else it may be replayed.
        lazy: Whether a function in Python gets the recorded tensors with all their rows, and itself selects the rows of
            the present step; else it gets only these rows.
    """

    name: str
    function: Callable[..., Mapping[str, Any] | None]
    reads: tuple[str, ...] = ()
    python: bool = False
    lazy: bool = False


def run_stages(stages: Iterable[Stage], earlier: Mapping[str, Any]) -> dict[str, Any]:
    """Runs stages eagerly; returns the earlier results and the results of the stages."""
    results = dict(earlier)
    for stage in stages:
        results |= stage.function(*[results[name] for name in stage.reads]) or {}
    return results


class SegmentResult(NamedTuple):
    """The result of a call of a segment, valid until the next call.

    Attributes:
        value: The function's result in the recorded call, or in this call if it ran eagerly.
        recording: The recording that holds the result; None if this call ran eagerly.
        times: The number of times that this call ran or replayed the function.
    """

    value: Any
    recording: Recording | None = None
    times: int = 1

    def now(self, value: Any) -> Any:
        """Returns the argument with only the rows that this call has filled.

        Args:
            value: The attribute ``value``, or a part of it.
        """
        return value if self.recording is None else self.recording.now(value)


class Segment:
    """A function that is recorded in its first call; later calls replay its compiled calls.

    Attributes:
        recording: The recorded calls; None if there is no recording.
        replayed: Whether the last call was replayed.
        obstacle: The reason why the last recording cannot be replayed; "" if it can.
        eager_calls: The number of upcoming calls that run eagerly, as a back-off after recordings that could not be
            replayed.

    Examples:
        >>> import torch
        >>> from voronerf.nerf.segment import Segment
        >>> from voronerf.ops import nearest_centre
        >>> segment, centres = Segment(), torch.tensor([[0.0, 0, 0], [1, 1, 1]])
        >>> find = lambda points: nearest_centre(points, centres)
        >>> for rows in (7, 8):
        ...     made = segment(find, torch.ones(rows, 3))
        >>> segment.replayed, made.now(made.value)
        (True, tensor([1, 1, 1, 1, 1, 1, 1, 1], dtype=torch.int32))
    """

    def __init__(self) -> None:
        self.replayed, self.obstacle, self.eager_calls, self._backoff = False, "", 0, 0
        self._numbers = list[int]()  # the row counts of this call
        self.forget()

    def forget(self) -> None:
        """Drops the recording, so the next call is recorded again."""
        self.recording: Recording | None = None
        self._value: Any = None
        self._results, self._key = list[Any](), list[Any]()

    def __call__(self, function: Callable[..., Any], *arguments: Any, times: int = 1) -> SegmentResult:
        """Returns the result of a function; replays the recorded calls of the function if possible.

        Args:
            function: The function, which does the same in each call apart from its arguments.
            arguments: Results of other segments (`SegmentResult`), which are read in place; row counts; or tensors in
                tuples, dictionaries and dataclasses, which are copied. The numbers of rows may change from call to
                call.
            times: The number of replays in a row; if there is no recording, the function is called once.
        """
        tensors, key = _flatten(arguments)
        self._numbers = [each for each in arguments if type(each) is int]
        results = [each for each in arguments if isinstance(each, SegmentResult)]
        recorded = self.recording
        if recorded is not None and len(results) == len(self._results) and key == self._key:
            same_results = all(each.value is value for each, value in zip(results, self._results))
            if same_results and (times_made := recorded.replay(backends.threads(), times, tensors)):
                self.replayed, self._backoff, self.eager_calls = True, 0, 0
                return SegmentResult(self._value, recorded, times_made)
        self.replayed = False
        if self.eager_calls or any(each.recording is None for each in results):
            self.eager_calls = max(0, self.eager_calls - 1)
            return SegmentResult(
                function(*(each.now(each.value) if isinstance(each, SegmentResult) else each for each in arguments))
            )
        self.eager_calls, self._backoff = self._backoff, min(2 * self._backoff or 1, MAX_BACKOFF)
        with Recording(*(each.recording for each in results if each.recording is not None)) as recording:
            value = function(*self._in_recorded_memory(recording, arguments))
        self.forget()
        self.obstacle = recording.obstacle or ""
        if self.obstacle:
            return SegmentResult(value)
        self.recording, self._value = recording, value
        self._results, self._key = [each.value for each in results], key
        return SegmentResult(value, recording)

    def _in_recorded_memory(self, recording: Recording, arguments: Iterable[Any]) -> Iterator[Any]:
        """Yields the arguments in the memory that replays read."""

        def take(argument: Any) -> Any:
            if type(argument) is int and argument:
                return recording.count(lambda: argument)
            return recording.take(argument) if isinstance(argument, Tensor) else mapped(take, argument)

        place = itertools.count()
        for argument in arguments:
            if isinstance(argument, SegmentResult):
                yield argument.value if argument.recording is None else argument.recording.counted_now(argument.value)
            elif type(argument) is int:
                yield recording.count(functools.partial(self._number, next(place)))
            else:
                yield take(argument)

    def _number(self, place: int) -> int:
        return self._numbers[place]


def _flatten(arguments: Iterable[Any]) -> tuple[list[Tensor], list[Any]]:
    """Returns all tensors of the arguments, and a key of everything else except row counts: types, dtypes, shapes."""
    tensors, kinds = list[Tensor](), list[Any]()

    def look(held: Any) -> None:
        if isinstance(held, Tensor):
            tensors.append(held)
            kinds.append((held.dtype, held.dim(), *held.shape[1:]))
        elif (entries := entries_of(held)) is not None:
            kinds.append((type(held), [*held] if isinstance(held, dict) else len(entries)))
            for argument in entries:
                look(argument)
        else:
            kinds.append(held)

    for argument in arguments:
        if not isinstance(argument, SegmentResult) and type(argument) is not int:
            look(argument)
    return tensors, kinds
