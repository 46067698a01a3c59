"""Segments of a training step, whose compiled calls are recorded once and made again, and hooks in Python between."""

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

#: After a recording that no call has replayed, the next 1, 2, 4, ... calls run as they are, so many at most.
LONGEST_WAIT = 64
_REPLAYED = set[type]()
_HARMLESS = {
    *("__dict__", "__weakref__", "__init__", "__init_subclass__", "__class_getitem__"),
    *("__repr__", "__str__", "__eq__", "__hash__", "__reduce__", "__getstate__", "__setstate__"),
}


def replayed(kind: T) -> T:
    """Says of a class that a step may make the calls of its hooks again in their place (:class:`TrainingStep`).

    All that its methods compute must be the work of ops, or of torch entry by entry; what changes from step to step
    must lie in tensors. What Python does beside that is done once, while the step is recorded. The classes of this
    package are so. A subclass that is not, and overrides a hook, has this hook called in each step; one that overrides
    anything else has all of its hooks called. A step follows attributes of objects, not of classes.

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
    """Whether a hook of an object must be called in each step, since its class is not `replayed`; "" for any."""
    kind: Any = type(part)
    return hook in getattr(part, "__dict__", ()) or _overrides(kind, hook)


@functools.lru_cache(maxsize=256)
def _overrides(kind: Any, hook: str) -> bool:
    """Whether a class overrides a hook of a `replayed` one, or what that may call."""
    known = next((base for base in kind.__mro__ if base in _REPLAYED), None)
    if known is None:
        return True
    protocol, names = [base for base in kind.__mro__ if base in _REPLAYED][-1], _names_read(kind)
    before = kind.__mro__[: kind.__mro__.index(protocol)]
    own = [each for base in before if base not in _REPLAYED for each in vars(base).items()]
    behaviour = {name for name, value in own if callable(value) or hasattr(value, "__get__")}
    others = {name for name in behaviour - _HARMLESS if hasattr(known, name) or name in names or name == "__getattr__"}
    return hook in others or any(not hook or not callable(getattr(protocol, name, None)) for name in others)


def free_names(part: Any) -> list[str]:
    """The attributes of an object that no `replayed` class reads, so that they may change from step to step."""
    kind: Any = type(part)
    known = _names_read(kind)
    return [name for name in vars(part) if name not in known]


@functools.lru_cache(maxsize=256)
def _names_read(kind: Any) -> frozenset[str]:
    """The attributes of `self` in the code of a class and its bases, of those that are `replayed`."""
    found, codes = set[str](), list[types.CodeType]()
    for base in filter(_REPLAYED.__contains__, kind.__mro__):
        for value in vars(base).values():
            held = (value.fget, value.fset) if isinstance(value, property) else (inspect.unwrap(value),)
            codes += [each.__code__ for each in held if inspect.isfunction(each)]
    while codes:
        code = codes.pop()
        for before, now in itertools.pairwise(dis.get_instructions(code)):
            of_self = before.argrepr.rpartition(", ")[2] == "self"  # newer Pythons load two names at once
            if of_self and now.opname in ("LOAD_ATTR", "LOAD_METHOD", "STORE_ATTR"):
                found.add(now.argval)
        codes += [each for each in code.co_consts if inspect.iscode(each)]
    return frozenset(found)


class Stage(NamedTuple):
    """A part of a step.

    Attributes:
        name: The one that people see.
        function: Takes what stages before have made; gives what it makes, by names, or None.
        reads: The names of what it takes.
        python: Whether it is called in each step, else it may be replayed.
        lazy: Whether it is given, in Python, what was recorded, and asks itself for what replays have filled.
    """

    name: str
    function: Callable[..., Mapping[str, Any] | None]
    reads: tuple[str, ...] = ()
    python: bool = False
    lazy: bool = False


def run_stages(stages: Iterable[Stage], made: Mapping[str, Any]) -> dict[str, Any]:
    """Runs stages as they are, and gives what was made before and by them."""
    known = dict(made)
    for stage in stages:
        known |= stage.function(*[known[name] for name in stage.reads]) or {}
    return known


class Made(NamedTuple):
    """The result of a segment, until its next call.

    Attributes:
        value: The result of the recorded call, or of this one.
        recording: The recording that made it; None where this call ran as it is.
        times: How often its calls were made.
    """

    value: Any
    recording: Recording | None = None
    times: int = 1

    def now(self, value: Any) -> Any:
        """The value or a part of it, with as many rows as this call has filled."""
        return value if self.recording is None else self.recording.now(value)


class Segment:
    """A function that is recorded when it is first called; later calls make its compiled calls again.

    Attributes:
        recording: The recorded calls; None before there is one.
        replayed: Whether the last call was.
        obstacle: The reason why the last recording was not replayed; "" for none.
        left: The number of calls that run as they are, since the last recordings were not replayed.

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
        self.replayed, self.obstacle, self.left, self._wait = False, "", 0, 0
        self._numbers = list[int]()  # of rows, of this call
        self.forget()

    def forget(self) -> None:
        """Records the next call anew."""
        self.recording: Recording | None = None
        self._value: Any = None
        self._read, self._taken = list[Any](), list[Any]()

    def __call__(self, function: Callable[..., Any], *given: Any, times: int = 1) -> Made:
        """The result of a function.

        Args:
            function: Does the same in each call, but for what it is given.
            given: Results of other segments (`Made`), whose memory stays; numbers of rows; or tensors in tuples,
                dictionaries and dataclasses, which are copied. All of them may have other rows in each call.
            times: How often to make its calls in a row; it is called once where they cannot be made.
        """
        tensors, taken = _taken_apart(given)
        self._numbers = [each for each in given if type(each) is int]
        read = [each for each in given if isinstance(each, Made)]
        known = self.recording
        if known is not None and len(read) == len(self._read) and taken == self._taken:
            same = all(each.value is value for each, value in zip(read, self._read))
            if same and (made := known.replay(backends.threads(), times, tensors)):
                self.replayed, self._wait, self.left = True, 0, 0
                return Made(self._value, known, made)
        self.replayed = False
        if self.left or any(each.recording is None for each in read):
            self.left = max(0, self.left - 1)
            return Made(function(*(each.now(each.value) if isinstance(each, Made) else each for each in given)))
        self.left, self._wait = self._wait, min(2 * self._wait or 1, LONGEST_WAIT)
        with Recording(*(each.recording for each in read if each.recording is not None)) as recording:
            value = function(*self._placed(recording, given))
        self.forget()
        self.obstacle = recording.obstacle or ""
        if self.obstacle:
            return Made(value)
        self.recording, self._value = recording, value
        self._read, self._taken = [each.value for each in read], taken
        return Made(value, recording)

    def _placed(self, recording: Recording, given: Iterable[Any]) -> Iterator[Any]:
        """The arguments, in memory where replays find them."""

        def take(each: Any) -> Any:
            if type(each) is int and each:
                return recording.count(lambda: each)
            return recording.take(each) if isinstance(each, Tensor) else mapped(take, each)

        place = itertools.count()
        for each in given:
            if isinstance(each, Made):
                yield each.value if each.recording is None else each.recording.counted_now(each.value)
            elif type(each) is int:
                yield recording.count(functools.partial(self._number, next(place)))
            else:
                yield take(each)

    def _number(self, place: int) -> int:
        return self._numbers[place]


def _taken_apart(given: Iterable[Any]) -> tuple[list[Tensor], list[Any]]:
    """All tensors of what is given, and what it is but for their rows: types, dtypes, shapes, and whatever else."""
    tensors, kinds = list[Tensor](), list[Any]()

    def look(held: Any) -> None:
        if isinstance(held, Tensor):
            tensors.append(held)
            kinds.append((held.dtype, held.dim(), *held.shape[1:]))
        elif (entries := entries_of(held)) is not None:
            kinds.append((type(held), [*held] if isinstance(held, dict) else len(entries)))
            for each in entries:
                look(each)
        else:
            kinds.append(held)

    for each in given:
        if not isinstance(each, Made) and type(each) is not int:
            look(each)
    return tensors, kinds
