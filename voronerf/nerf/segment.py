"""Segments of a training step: their compiled calls are recorded once and replayed, with Python hooks in between."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.recording import Recording, entries_of, mapped
from voronerf.router.double import observed_class

T = TypeVar("T", bound=type)

#: The maximum number of eager calls after a recording that could not be replayed. The number is 0 after the first such
#: recording and 1 after the second, and then doubles.
MAX_BACKOFF = 64
_REPLAYED = set[type]()
_HARMLESS = {
    *("__dict__", "__weakref__", "__init__", "__init_subclass__", "__class_getitem__"),
    *("__repr__", "__str__", "__eq__", "__hash__", "__reduce__", "__getstate__", "__setstate__"),
    "step",  # of an optimiser, which torch's schedulers replace; a TrainingStep calls ``update`` instead
}


def replayed(kind: T) -> T:
    """Marks a class whose hooks a :class:`TrainingStep` may record and replay instead of calling them.

    Its methods must compute only with ops and elementwise functions of torch, and data that changes from step to step
    must lie in tensors. Other Python code runs only once, while the step is recorded. All classes of this package are
    marked. If an unmarked subclass, or an object itself, overrides a hook, this hook runs in Python in each step. If it
    overrides another member that hooks may use, or if a subclass adds a property, all its hooks run in Python in each
    step. A step detects changes of instance attributes, also within lists, tuples, dictionaries and dataclasses, but
    not of class attributes.

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
    return kind


def in_python(part: Any, hook: str = "") -> bool:
    """Returns whether a hook of an object must be called in each step instead of being replayed.

    Args:
        part: The object.
        hook: The name of the hook; "" asks whether this is true of any hook of the object.
    """
    kind: Any = type(part)
    replaced = _methods(kind).intersection(getattr(part, "__dict__", ()))
    return _overrides(kind, replaced, hook)


@functools.lru_cache(maxsize=256)
def _methods(kind: Any) -> frozenset[str]:
    return frozenset(name for name in dir(kind) if callable(getattr(kind, name, None)))


@functools.lru_cache(maxsize=256)
def _overrides(kind: Any, replaced: frozenset[str], hook: str) -> bool:
    """Returns whether a class, or the methods that an object itself replaces, change what a hook does."""
    replayed_base = next((base for base in kind.__mro__ if base in _REPLAYED), None)
    if replayed_base is None:
        return True
    protocol, overridden = [base for base in kind.__mro__ if base in _REPLAYED][-1], set(replaced)
    for base in kind.__mro__[: kind.__mro__.index(protocol)]:
        for name, value in vars(base).items() if base not in _REPLAYED else ():
            is_method = callable(value) or isinstance(value, classmethod)
            changes = hasattr(replayed_base, name) if is_method else hasattr(value, "__get__")
            overridden |= {name} if changes or name == "__getattr__" else set()
    overridden -= _HARMLESS
    return hook in overridden or any(not hook or not callable(getattr(protocol, name, None)) for name in overridden)


def note_attributes(guard: Any, parts: Iterable[Any]) -> list[tuple[Any, set[str]]]:
    """Adds the attributes of objects to a guard (`voronerf.ops._core.unchanged`).

    Returns:
        The objects whose class is not `replayed` itself, each with a set to which :func:`noting_reads` adds the names
        of the attributes that matter. All attributes of the other objects matter.
    """
    waiting, seen, reads = [*parts], set[int](), list[tuple[Any, set[str]]]()
    for part in waiting[:]:
        if type(part) not in _REPLAYED:
            reads.append((part, set()))
            guard.contents(vars(part), read=reads[-1][1])
    while waiting:
        held = waiting.pop()
        held = vars(held) if type(held) in _REPLAYED else held
        if (entries := entries_of(held)) is not None and id(held) not in seen:
            seen.add(id(held))
            waiting += entries
            if isinstance(held, (list, tuple, dict)):
                guard.contents(held)
            elif hasattr(held, "__dict__"):  # a dataclass
                guard.contents(vars(held))
            else:
                guard.attributes(held, [*held.__dataclass_fields__])
    return reads


def noting_reads(reads: Iterable[tuple[Any, set[str]]], function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a function; for each (object, names) it adds to ``names`` the attributes that are read from the object."""
    names, kinds = {id(part): names for part, names in reads}, [(part, type(part)) for part, _ in reads]

    def read(part: Any, name: str) -> None:
        names[id(part)].update((name, *(object.__getattribute__(part, name) if name == "__dict__" else ())))

    try:
        for part, kind in kinds:
            object.__setattr__(part, "__class__", observed_class(kind, read))
        return function(*arguments)
    finally:
        for part, kind in kinds:
            object.__setattr__(part, "__class__", kind)


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


class _Recorded(NamedTuple):
    """A recording with the function's result, and with the results of other segments and the key of its arguments."""

    recording: Recording
    value: Any
    results: list[Any]
    key: list[Any]


class Segment:
    """A function that is recorded in its first call; later calls replay its compiled calls.

    Attributes:
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

    @property
    def recording(self) -> Recording | None:
        """The recorded calls; None if there is no recording."""
        return None if self._recorded is None else self._recorded.recording

    def forget(self) -> None:
        """Drops the recording, so the next call is recorded again."""
        self._recorded: _Recorded | None = None

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
        recorded = self._recorded
        if recorded is not None and len(results) == len(recorded.results) and key == recorded.key:
            same_results = all(each.value is value for each, value in zip(results, recorded.results))
            if same_results and (times_made := recorded.recording.replay(backends.threads(), times, tensors)):
                self.replayed, self._backoff, self.eager_calls = True, 0, 0
                return SegmentResult(recorded.value, recorded.recording, times_made)
        self.replayed = False
        if self.eager_calls or any(each.recording is None for each in results):
            self.eager_calls = max(0, self.eager_calls - 1)
            return SegmentResult(
                function(*(each.now(each.value) if isinstance(each, SegmentResult) else each for each in arguments))
            )
        self.eager_calls, self._backoff = self._backoff, min(2 * self._backoff or 1, MAX_BACKOFF)
        recording = Recording(*(each.recording for each in results if each.recording is not None))
        value = recording.record(lambda: function(*self._in_recorded_memory(recording, arguments)))
        self.obstacle, self._recorded = recording.obstacle or "", None
        if self.obstacle:
            return SegmentResult(value)
        self._recorded = _Recorded(recording, value, [each.value for each in results], key)
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
