"""A list of stages, such as a training step, runs eagerly, is recorded and replayed, or is captured as a CUDA graph."""

from __future__ import annotations

import functools
import itertools
import operator
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor, nn

from voronerf.ops._core import backends
from voronerf.ops._core.capture import Capture
from voronerf.ops._core.custom_op import has_listeners
from voronerf.ops._core.recording import Recording, entries_of, mapped
from voronerf.ops._core.unchanged import Stale, unchanged
from voronerf.router.double import observed_class

T = TypeVar("T", bound=type)

#: The maximum number of eager calls after a recording that could not be replayed. The number is 0 after the first such
#: recording and 1 after the second, and then doubles.
MAX_BACKOFF = 64
_REPLAYED = set[type]()
_REGISTRIES = ("_parameters", "_buffers", "_modules")  # of modules
_HOOKS = ("_backward_hooks", "_post_accumulate_grad_hooks")  # attributes of parameters
#: Functions on whose results every recording depends.
_QUESTIONS = (
    torch.is_grad_enabled,
    torch.are_deterministic_algorithms_enabled,
    backends.cpu_precision,
    lambda: torch.backends.cuda.matmul.fp32_precision,
    *(functools.partial(torch.is_autocast_enabled, kind) for kind in ("cpu", "cuda")),
    *(functools.partial(torch.get_autocast_dtype, kind) for kind in ("cpu", "cuda")),
)
_HARMLESS = {
    *("__dict__", "__weakref__", "__init__", "__init_subclass__", "__class_getitem__"),
    *("__repr__", "__str__", "__eq__", "__hash__", "__reduce__", "__getstate__", "__setstate__"),
    "step",  # of an optimiser, which torch's schedulers replace; a TrainingStep calls ``update`` instead
}


def replayed(kind: T) -> T:
    """Marks a class whose hooks a :class:`TrainingStep` may record and replay instead of calling them.

    Its methods must compute only with ops and elementwise functions of torch, and data that changes from step to step
    must lie in tensors. Other Python code runs only once, while the step is recorded. All classes of this package are
    marked. If an unmarked subclass, or an object itself, overrides a hook, this hook runs in Python in each step. If
    the class or object overrides another member that hooks may use, or the class adds a property, all its hooks run in
    Python in each step. A step detects changes of instance attributes, also within lists, tuples, dictionaries and
    dataclasses, but not of class attributes.

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


def _observed(reads: Iterable[tuple[Any, set[str]]], function: Callable[..., Any], *arguments: Any) -> Any:
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
        uses: Function that returns the objects that the function uses. A replay depends on their attributes; a method
            ``note_dependencies`` of a class notes other dependencies, and returns further objects.
        python: Whether the function is called in each step; else it may be replayed.
        lazy: Whether the function takes recorded tensors with their spare rows and, as an additional first argument, a
            function that cuts tensors to the rows of the present step.
        restore: Function of the stage's results, called after they have been replayed; None for none.
    """

    name: str
    function: Callable[..., Mapping[str, Any] | None]
    reads: tuple[str, ...] = ()
    uses: Callable[[], Iterable[Any]] = tuple
    python: bool = False
    lazy: bool = False
    restore: Callable[[Mapping[str, Any]], None] | None = None

    @classmethod
    def of_hook(cls, part: Any, *hooks: str, function: Callable[..., Any], reads: tuple[str, ...]) -> Stage:
        """Returns the stage of an object's hook; it runs in Python if `in_python` is true of one of ``hooks``."""
        python = any(in_python(part, hook) for hook in hooks)
        return cls(f"{type(part).__name__}.{hooks[0]}", function, reads, lambda: (part,), python)

    def run(self, results: Mapping[str, Any], now: Callable[[Any], Any] = lambda held: held) -> Mapping[str, Any]:
        """Calls the function with results of earlier stages; for ``now`` see the attribute ``lazy``."""
        values = [results[name] for name in self.reads]
        return (self.function(now, *values) if self.lazy else self.function(*values)) or {}


def run_stages(stages: Iterable[Stage], earlier: Mapping[str, Any]) -> dict[str, Any]:
    """Runs stages eagerly; returns the earlier results and the results of the stages."""
    results = dict(earlier)
    for stage in stages:
        results |= stage.run(results)
    return results


class Results(NamedTuple):
    """The results of stages by name, valid until the next call.

    Attributes:
        value: The results in the recorded call, or in this call if it ran eagerly.
        recording: The recording that holds the results; None if there is none.
        times: The number of times that this call ran or replayed the stages.
    """

    value: Mapping[str, Any]
    recording: Recording | None = None
    times: int = 1

    def now(self, value: Any) -> Any:
        """Returns the attribute ``value``, or an object in it, with only the rows that this call has filled."""
        return value if self.recording is None else self.recording.now(value)


_NOTHING = Results({})


class _Segment:
    """Consecutive stages that are all called in Python, or of which one recording or capture is made."""

    def __init__(self, python: bool) -> None:
        self.stages, self.python, self.obstacle = list[Stage](), python, ""
        self.eager_calls = self._backoff = 0  # upcoming eager calls after recordings that could not be replayed
        self.recorded: Results | None = None
        self.recording: Any = None  # the `Recording` or `Capture`
        self._earlier: Any = None  # the value of the earlier results in the recorded call
        self._inputs, self._key = dict[str, Any](), list[Any]()

    def replay(self, earlier: Results, inputs: dict[str, Any], times: int) -> Results | None:
        """Replays the recorded calls; returns None if that is not possible.

        Args:
            earlier: The results of earlier segments, which are read in place.
            inputs: Further results: numbers of rows, or objects with tensors that are copied. The number of rows may
                change from call to call.
            times: The number of replays in a row.
        """
        self._inputs, (tensors, key), recorded = inputs, _flatten(inputs), self.recorded
        if recorded is None or earlier.value is not self._earlier or key != self._key:
            return None
        if not (completed := self.recording.replay(backends.threads(), times, tensors)):
            return None
        self.eager_calls = self._backoff = 0
        _restore(self.stages, recorded)
        return recorded._replace(times=completed)

    def may_record(self, earlier: Results) -> bool:
        """Returns whether to record this call; after each recording that is never replayed, more calls run eagerly."""
        if self.eager_calls or (earlier is not _NOTHING and earlier.recording is None):
            self.eager_calls = max(0, self.eager_calls - 1)
            return False
        self.eager_calls, self._backoff = self._backoff, min(2 * self._backoff or 1, MAX_BACKOFF)
        return True

    def record(self, run: Callable[..., dict[str, Any]], earlier: Results, recording: Any) -> Results:
        """Runs the stages on the inputs of the last :meth:`replay`, and records or captures the compiled calls."""
        inputs = self._inputs

        def run_recorded() -> dict[str, Any]:
            results = {} if earlier.recording is None else dict(earlier.recording.counted_now(earlier.value))
            for name, held in inputs.items():
                is_count = type(held) is int
                results[name] = recording.count(lambda n=name: self._inputs[n]) if is_count else _take(recording, held)
            return run(self.stages, results)

        value, self.recorded, self.recording = recording.record(run_recorded), None, None
        self.obstacle = recording.obstacle or ""
        if self.obstacle:
            return Results(value)
        self.recording, self._earlier, self._key = recording, earlier.value, _flatten(inputs)[1]
        if isinstance(recording, Capture):
            self.recorded = Results(recording.result)
            return Results(value)
        self.recorded = Results(value, recording)
        return self.recorded


def _take(recording: Any, held: Any) -> Any:
    """Replaces the tensors and row counts of an input by the tensors and counts of a recording."""
    # A nested function that calls itself would keep the recording, and its memory, until garbage is collected.
    if type(held) is int and held:
        return recording.count(lambda: held)
    take = functools.partial(_take, recording)
    return recording.take(held) if isinstance(held, Tensor) else mapped(take, held)


def _restore(stages: Iterable[Stage], results: Results) -> None:
    for stage in stages:
        if stage.restore is not None:
            stage.restore(results.value)


def _flatten(inputs: Mapping[str, Any]) -> tuple[list[Tensor], list[Any]]:
    """Returns all tensors of the inputs, and a key of everything else except row counts: types, dtypes, shapes."""
    tensors, kinds = list[Tensor](), list[Any]()

    def look(held: Any) -> None:
        if isinstance(held, Tensor):
            tensors.append(held)
            kinds.append((held.dtype, held.dim(), *held.shape[1:]))
        elif (entries := entries_of(held)) is not None:
            kinds.append((type(held), [*held] if isinstance(held, dict) else len(entries)))
            for entry in entries:
                look(entry)
        else:
            kinds.append(held)

    look({name: None if type(held) is int else held for name, held in inputs.items()})
    return tensors, kinds


class Replay:
    """A list of stages: recorded and replayed on the CPU, captured as a CUDA graph, or run eagerly.

    Consecutive stages that can be replayed are recorded together; other stages are called in Python in between. If a
    stage in Python changes a dependency, the later stages of the call run eagerly.

    Args:
        stages: Function that returns the stages; it is called again when a dependency has changed.
        obstacle: Function that returns the reason why the stages cannot be replayed; "" or None if they can.
        within: Function that returns a new context manager, in which stages run if they are not replayed.
        gpu: Function that returns the device and the generator of a capture; None on the CPU.

    Examples:
        >>> import torch
        >>> from voronerf.nerf.replay import Replay, Stage
        >>> from voronerf.ops import nearest_centre
        >>> points, centres = torch.rand(9, 3), torch.tensor([[0.0, 0, 0], [1, 1, 1]])
        >>> find = Stage("find", lambda points: {"cells": nearest_centre(points, centres)}, ("points",))
        >>> replay = Replay(lambda: [find])
        >>> for rows in (7, 8):
        ...     results = replay({"points": torch.ones(rows, 3)})
        >>> replay.explain(), results.now(results.value["cells"])
        ('recorded and replayed, 1 calls', tensor([1, 1, 1, 1, 1, 1, 1, 1], dtype=torch.int32))
    """

    def __init__(
        self,
        stages: Callable[[], list[Stage]],
        obstacle: Callable[[], str | None] = str,
        *,
        within: Callable[[], AbstractContextManager[Any]] = nullcontext,
        gpu: Callable[[], tuple[torch.device, torch.Generator] | None] = lambda: None,
    ) -> None:
        self._make, self._find_obstacle, self._within, self._gpu = stages, obstacle, within, gpu
        self._segments = list[_Segment]()
        self.forget()

    def forget(self) -> None:
        """Drops all recordings, so the next call is recorded again; the rest of a running call runs eagerly."""
        self._dependencies: Any = Stale()
        self._reads = list[tuple[Any, set[str]]]()  # objects, and the names of the attributes that recorded stages read
        self._stages, self._obstacle = list[Stage](), ""
        for segment in self._segments:
            segment.recorded = segment.recording = None
        self._spent = dict[str, tuple[float, int]]()  # seconds and calls of each stage in Python

    def __call__(self, inputs: dict[str, Any], times: int = 1) -> Results:
        """Runs the stages once, or replays them.

        Args:
            inputs: The inputs of the stages by name: row counts, or objects with tensors.
            times: The maximum number of replays in a row.
        """
        is_unchanged = not has_listeners() and self._dependencies.holds()
        if not is_unchanged:
            self.forget()
            self._stages, self._obstacle = self._make(), self._obstacle_now()
            if self._obstacle:
                return Results(self._run(self._stages, inputs))
            self._group()
        if (gpu := self._gpu()) is None and not is_unchanged:
            self._note(False)  # before the hooks, which may change the dependencies
        last, has_called, times = _NOTHING, False, times if len(self._segments) == 1 else 1
        for segment in self._segments:
            if segment.python:
                for stage in segment.stages:
                    inputs = {**inputs, **self._call_in_python(stage, inputs, last)}
                has_called = True
                continue
            if has_called and not self._dependencies.holds():
                last = self._run_rest(segment, last, inputs)
            elif (replayed := segment.replay(last, inputs, times)) is not None:
                last = replayed
            elif gpu is not None and not is_unchanged:
                last = self._run_rest(segment, last, inputs)
                segment.obstacle = "it needs a warm-up step before the capture"
                self._note(True)
            elif not segment.may_record(last):
                last = self._run_rest(segment, last, inputs)
            elif gpu is None:
                run = functools.partial(_observed, self._reads, self._run)
                last = segment.record(run, last, Recording(*filter(None, [last.recording])))
            else:
                self._dependencies = Stale()
                last = segment.record(self._run, last, Capture(*gpu, segment.recorded and segment.recording))
                self._note(True)
                _restore(segment.stages, last)  # the gradients of the warm-up
            inputs = {}
        return last

    def _group(self) -> None:
        """Divides the stages into segments; an unchanged segment keeps its number of eager calls to come (back-off)."""
        before, self._segments = self._segments, []
        for place, (python, stages) in enumerate(itertools.groupby(self._stages, operator.attrgetter("python"))):
            kept = place < len(before) and before[place].python == python
            self._segments.append(before[place] if kept else _Segment(python))
            self._segments[-1].stages = [*stages]

    def _run(self, stages: list[Stage], results: Mapping[str, Any]) -> dict[str, Any]:
        with self._within():
            return run_stages(stages, results)

    def _run_rest(self, segment: _Segment, last: Results, inputs: Mapping[str, Any]) -> Results:
        """Runs a segment eagerly."""
        return Results(self._run(segment.stages, {**last.now(last.value), **inputs}))

    def _call_in_python(self, stage: Stage, inputs: Mapping[str, Any], last: Results) -> Mapping[str, Any]:
        """Calls a stage in Python with its inputs and the results of earlier segments."""
        began, cut = time.perf_counter(), (lambda held: held) if stage.lazy else last.now
        with self._within():
            values = {name: inputs[name] if name in inputs else cut(last.value[name]) for name in stage.reads}
            results = stage.run(values, last.now)
        seconds, calls = self._spent.get(stage.name, (0.0, 0))
        self._spent[stage.name] = seconds + time.perf_counter() - began, calls + 1
        return results

    def _note(self, gpu: bool) -> None:
        """Notes the dependencies of the stages; on a GPU also their tensors, which a capture does not track."""
        if (compiled := backends.compiled()) is None:
            return
        noted, waiting, seen, reads = unchanged(), list[Any](), dict[int, Any](), list[tuple[Any, set[str]]]()
        for question in (backends.threads, compiled.isa, *_QUESTIONS):
            noted.answer(question)
        for stage in self._stages:
            for part in stage.uses():
                members = getattr(part, "__dict__", {})
                if stage.python:
                    noted.entries(members, [*_methods(cast(Any, type(part)))])  # replaced methods run in Python
                elif not _is_partly_read(part):
                    waiting.append(part)
                elif gpu:
                    waiting.append(members)
                elif id(part) not in seen:
                    seen[id(part)] = part
                    reads.append((part, set()))
                    noted.contents(members, read=reads[-1][1])
        while waiting:
            held = waiting.pop()
            if id(held) not in seen:
                seen[id(held)] = held
                waiting += _note_object(noted, held, gpu)
        self._dependencies, self._reads = noted, reads

    def _obstacle_now(self) -> str:
        listening = "a mode, a transform or a profiler of torch is active"
        return listening if has_listeners() else self._find_obstacle() or ""

    def explain(self, *others: Replay) -> str:
        """Describes whether the stages are replayed, here and in other replays, and lists the stages in Python."""
        recorded = [segment.recording for segment in self._segments if segment.recorded is not None]
        if recorded and isinstance(recorded[0], Capture):
            return "captured and replayed as a CUDA graph"
        obstacles = [each.obstacle for replay in (self, *others) for each in replay._segments if each.obstacle]
        own = next((each.obstacle for each in self._segments if each.obstacle), "")
        obstacle = self._obstacle or self._obstacle_now() or own
        if obstacle and not recorded:
            return f"runs eagerly, since {obstacle}"
        eager = max((segment.eager_calls for segment in self._segments), default=0)
        if eager and not obstacle:
            steps = f"{eager} more step{'s' * (eager > 1)}"
            return f"runs eagerly for {steps}, since the last recordings could not be replayed"
        if not recorded or not self._dependencies.holds():
            return f"will be recorded{' again, since something that it reads has changed' * bool(recorded)}"
        calls, several = sum(map(len, recorded)), f" in {len(recorded)} segments" if len(recorded) > 1 else ""
        lines = [f"recorded and replayed, {calls} calls{several}"]
        lines += [f"another segment runs eagerly, since {each}" for each in obstacles]
        spent = self._spent.items()
        lines += [f"in Python: {name}, {1e3 * seconds / calls:.3f} ms a call" for name, (seconds, calls) in spent]
        return "\n".join(lines)


def _is_partly_read(part: Any) -> bool:
    """Returns whether only the attributes of an object that recorded stages read are dependencies."""
    is_whole = type(part) in _REPLAYED or isinstance(part, nn.Module) or hasattr(type(part), "note_dependencies")
    return hasattr(part, "__dict__") and not is_whole


def _note_object(noted: Any, held: Any, gpu: bool) -> Iterable[Any]:
    """Notes an object as a dependency, and returns the objects in it."""
    if isinstance(held, Tensor):
        if gpu:
            noted.layout(held)
        if not isinstance(held, nn.Parameter):
            return ()
        noted.attributes(held, ["requires_grad", *_HOOKS])
        return [*(getattr(held, name) for name in _HOOKS), held.grad if gpu else None]
    note, entries = getattr(type(held), "note_dependencies", None), entries_of(held)
    if isinstance(held, nn.Module):
        members = vars(held)
        registries = [each for name, each in members.items() if name in _REGISTRIES or name.endswith("_hooks")]
        return [*registries, *(noted.contents(members) or () if note is None else note(held, noted))]
    if note is not None:
        return cast("Iterable[Any]", note(held, noted))
    if isinstance(held, (list, tuple, dict)):
        noted.contents(held)
    elif hasattr(held, "__dict__") and (type(held) in _REPLAYED or entries is not None):
        return [vars(held)]
    elif entries is not None:
        noted.attributes(held, [*held.__dataclass_fields__])
    return entries or ()
