"""One call of a routed module: where its samples are, and how the module is run on them.

n samples in leading dimensions such as (rays, samples of a ray).
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.backends import BackendUnavailable
from voronerf.router.arguments import SHARED, Layout, Reordering, argument_names, map_result, tensors_of
from voronerf.router.checkpointing import rerun_in
from voronerf.router.fusion import Plan, Unrecognised, agree
from voronerf.router.grouping import Entries, Grouping, PerCell
from voronerf.router.loop import run_cells
from voronerf.router.memory import Memory
from voronerf.router.parameters import as_per_cell, in_place_of_parameters
from voronerf.router.rays import flattens
from voronerf.router.recording import Program, Recorder
from voronerf.router.rows import RowMode, Ungroupable
from voronerf.router.snapshot import Snapshot, tensor_key

_OP = "VoronoiRouter"
_STATES = 16  # of a module that calls of one kind are recorded in, before its state counts as one that never recurs
_CHECK_EVERY = 512  # uses of a plan it is held against the module's own forward: what that reads may be out of sight
_KINDS = 256  # of calls, told apart by types and sizes, beyond which a router begins anew
_VALUES = 16  # of the numbers and words among the arguments, beyond which calls are told apart by their types alone


class Call:
    """A method of the module with the arguments of one call.

    Attributes:
        method: its name.
        function: the bound method.
        args, kwargs: as they came.
        names: of the positional arguments.
    """

    def __init__(
        self, method: str, module: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], memory: Memory
    ) -> None:
        bound = getattr(module, method)
        # ``forward`` by way of the module, whose own hooks run then
        self.function: Callable[..., Any] = module.__call__ if method == "forward" else bound
        self.method, self.args, self.kwargs = method, args, kwargs
        names = memory.names.get((method, len(args)))
        if names is None:
            names = memory.names[method, len(args)] = argument_names(bound, len(args))
        self.names = names

    def locate(
        self, coords: Any, per_ray: Sequence[str | int] | None, shared: Sequence[str | int]
    ) -> tuple[Layout, Tensor, Tensor | None]:
        """Finds the positions.

        Args:
            coords: the rule, or positions [..., 3].
            per_ray: names or numbers of arguments, or None.
            shared: names or numbers of arguments.

        Returns:
            The layout, positions [..., 3], and the tensor whose identity stands for them, or None.

        Raises:
            ValueError: where no rule is given, or it does not fit the arguments.
        """
        if coords is None:
            raise ValueError(
                f"{_OP}: coords must say where the positions are, since a module's arguments do not: pass "
                "coords='first3', a slice of the features or a function of the arguments to the router, or "
                "coords=positions [..., 3] to this call"
            )
        source: Tensor | None
        if isinstance(coords, Tensor):
            positions, source, rule = coords, coords, "coords"
        elif callable(coords):
            positions, source, rule = coords(*self.args, **self.kwargs), None, "what coords returns"
        else:
            source = next((v for v in (*self.args, *self.kwargs.values()) if isinstance(v, Tensor)), None)
            if source is None:
                got = ", ".join(type(value).__name__ for value in (*self.args, *self.kwargs.values())) or "nothing"
                raise ValueError(
                    f"{_OP}: coords={coords!r} must find a tensor among the arguments, got {got}; pass a function"
                )
            if source.dim() == 0:
                raise ValueError(f"{_OP}: coords={coords!r} must find features in the first tensor, got a number")
            positions = source[..., :3] if coords == "first3" else source[..., coords]
            rule = f"what coords={coords!r} takes from the first tensor, {list(source.shape)},"
        if not isinstance(positions, Tensor):
            raise TypeError(f"{_OP}: {rule} must be a tensor, got {type(positions).__name__}")
        if positions.dim() == 0 or positions.shape[-1] != 3 or not positions.is_floating_point():
            raise ValueError(
                f"{_OP}: {rule} must have shape [..., 3] and a floating-point dtype, got {list(positions.shape)} of "
                f"{positions.dtype}"
            )
        layout = Layout(
            tuple(positions.shape[:-1]),
            None if per_ray is None else frozenset(self._name(item) for item in per_ray),
            frozenset(self._name(item) for item in shared),
        )
        return layout, positions, source

    def _name(self, item: str | int) -> str:
        return item if isinstance(item, str) else self.names[item] if item < len(self.names) else str(item)

    def arranged(self, order: Reordering) -> tuple[list[Any], dict[str, Any]]:
        """The arguments in another order."""
        args = [order.value(name, value) for name, value in zip(self.names, self.args, strict=True)]
        return args, {name: order.value(name, value) for name, value in self.kwargs.items()}

    def kind(self, layout: Layout, training: bool, *, values: bool = True) -> Any:
        """What decides how calls are carried out: arguments without the number of samples.

        Args:
            layout: of the arguments.
            training: the module's mode.
            values: whether numbers and words count by what they are, or by their type alone.
        """
        d = len(layout.lead)

        def describe(value: Any) -> Any:
            if isinstance(value, Tensor):
                ones = tuple(size == 1 for size in value.shape[:d])
                return tuple(value.shape[d - 1 :][1:]), value.dim(), value.dtype, ones
            if isinstance(value, (bool, type(None))) or (values and isinstance(value, (int, str))):
                return value
            return type(value)

        parts = [describe(value) for value in (*self.args, *self.kwargs.values())]
        return (self.method, training, len(layout.lead), tuple(self.kwargs), *parts)

    def same_for_all(self, layout: Layout) -> list[Tensor]:
        """The tensors among the arguments, not those inside of others, that have no rows."""
        given = [*zip(self.names, self.args, strict=True), *self.kwargs.items()]
        return [v for name, v in given if isinstance(v, Tensor) and layout.kind(name, v, False) == SHARED]

    def state(self, memory: Memory, module: nn.Module, kind: Any, layout: Layout, device: torch.device) -> Any:
        """All that the steps of a call may depend on beside the rows; None where it cannot be told."""
        if memory.snapshot is None:
            memory.snapshot = Snapshot(module)
        state = memory.snapshot.key()
        if state is None:
            memory.snapshot = None
            return None
        values = [value for value in (*self.args, *self.kwargs.values()) if not isinstance(value, Tensor)]
        autocast = torch.get_autocast_dtype(device.type) if torch.is_autocast_enabled(device.type) else None
        try:
            numbers = [_constant(value) for value in values]
        except TypeError:
            return None
        return (kind, autocast, *numbers, *map(tensor_key, self.same_for_all(layout)), *state)


def _constant(value: Any, depth: int = 0) -> Any:
    """An argument as a key, tensors by what they are like; raises TypeError for what cannot be one."""
    if isinstance(value, Tensor):
        return value.dim(), value.dtype
    if isinstance(value, (list, tuple)):
        return tuple(_constant(item, depth + 1) for item in value)
    if isinstance(value, dict):
        return tuple((key, _constant(item, depth + 1)) for key, item in value.items())
    if isinstance(value, (bool, int, float, str, type(None), Enum, torch.dtype, torch.device)) or callable(value):
        return value
    if hasattr(value, "__dict__") and depth < 4:
        return type(value), tuple((key, _constant(item, depth + 1)) for key, item in vars(value).items())
    raise TypeError


def _kind(module: nn.Module, call: Call, layout: Layout, memory: Memory) -> Any:
    """A call's kind: with the numbers and words among its arguments, while there are few of them."""
    kind, alike = (call.kind(layout, module.training, values=values) for values in (True, False))
    if alike not in memory.kinds and len(memory.kinds) >= _KINDS:
        memory.forget()
    known = memory.kinds.setdefault(alike, set())
    if len(known) < _VALUES:
        known.add(kind)
    return kind if kind in known else alike


def run_grouped(module: nn.Module, call: Call, layout: Layout, grouping: Grouping, memory: Memory) -> Any:
    """Runs a module for all cells, in one pass where that is possible.

    Args:
        module: with stacked parameters.
        call: of a method of it.
        layout: of the arguments.
        grouping: of the samples; of two rows where there are fewer samples.
        memory: of the router.
    """
    kind = _kind(module, call, layout, memory)
    if len(layout.lead) > 1 and layout.lead[-1] > 1 and layout.n and kind not in memory.flat:
        memory.flat[kind] = tuple(flattens(module, call, layout) or ())
    if memory.flat.get(kind):
        layout = replace(layout, flat=memory.flat[kind])
    if kind in memory.by_cell:
        return _run_by_cell(module, call, layout, grouping, memory, kind)
    state = None
    if layout.n >= 2 and memory.recorded.get(kind, 0) < _STATES:
        state = call.state(memory, module, kind, layout, grouping.device)
    plan = None if state is None else memory.plans.get(state)
    if isinstance(plan, Plan) and plan.fits(layout.n):
        result = _run_plan(plan, call, layout, grouping)
        plan.uses += 1
        if plan.uses % _CHECK_EVERY or _still_right(result, module, call, layout, grouping, memory):
            return result
        plan = changed = "its results have changed"
        memory.plans = {key: changed if isinstance(old, Plan) else old for key, old in memory.plans.items()}
        name = f"{type(module).__name__}.{call.method}"
        memory.say_once(
            f"{name} changes",
            f"{_OP}: {name} gives other results than when it was recognised, by what cannot be seen of it (a global or "
            "a closure?), and runs its own forward again; router.to(device) makes a router forget what it recognised",
        )
    try:
        if state is None or isinstance(plan, (Plan, str)):
            return _run_at_once(module, call, layout, grouping, memory, None)
        recorder = Recorder.of(module)
        result = _run_at_once(module, call, layout, grouping, memory, recorder)
        memory.plans[state] = _next_plan(plan, recorder, call, layout, grouping, result)
        if plan is None:
            memory.recorded[kind] = memory.recorded.get(kind, 0) + 1
        return result
    except Ungroupable as error:
        reason, failure = str(error), None
    except BackendUnavailable:
        raise
    except Exception as error:
        if str(error).startswith(_OP) or _is_memory(error):
            raise
        reason, failure = f"its forward fails on the samples of all cells ({error})", error
    try:
        result = _run_by_cell(module, call, layout, grouping, memory, kind)
    except Exception as error:
        raise error from failure
    memory.by_cell[kind] = reason
    if grouping.k > 1:
        memory.say_once(
            f"{type(module).__name__}.{call.method}",
            f"{_OP}: {type(module).__name__}.{call.method} runs cell by cell: {reason}",
        )
    return result


def run_entries(
    module: nn.Module,
    call: Call,
    layout: Layout,
    entries: Entries,
    memory: Memory,
    wrap: Callable[[Tensor], Any],
) -> Any:
    """Runs a module on chosen samples in chosen cells, after :func:`run_grouped` of the same call.

    Args:
        module: with stacked parameters.
        call: of a method of it.
        layout: of the arguments.
        entries: m >= 2 samples with their cells.
        memory: of the router.
        wrap: makes of a tensor of rows [m, ...] or [m * entries of a sample, ...] what stands for it in the result.
    """

    def place(rows: Tensor, number: int) -> Any:
        each = rows.shape[0] // entries.n
        return wrap(entries.unsort(rows.reshape(entries.n, each, *rows.shape[1:]) if each > 1 else rows))

    kind = _kind(module, call, layout, memory)
    if kind in memory.by_cell:
        return _run_by_cell(module, call, layout, entries, memory, kind, place)
    return _run_at_once(module, call, layout, entries, memory, None, place)


def _next_plan(
    recorded: Program | None, recorder: Recorder, call: Call, layout: Layout, grouping: Grouping, result: Any
) -> Plan | Program | str:
    """What to remember after a call was recorded: a plan, where it is the second of its kind and the plan is right."""
    program = recorder.program
    if program is None:
        return recorder.refused
    if recorded is None or (recorded.only_n is not None and recorded.only_n != layout.n):
        return program
    if not recorded.same(program):
        return "two calls took different steps"
    try:
        plan = Plan(program)
        with torch.no_grad():
            found = _run_plan(plan, call, layout, grouping)
    except Unrecognised as error:
        return str(error)
    return plan if agree(found, result) else "its results differ"


def _is_memory(error: Exception) -> bool:
    """Whether memory has run out, for which torch has a plain RuntimeError on a CPU."""
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "can't allocate memory" in str(error)


def _still_right(found: Any, module: nn.Module, call: Call, layout: Layout, grouping: Grouping, memory: Memory) -> bool:
    """Whether a plan's results are still those of the module's own forward."""
    if grouping.device.type == "cuda" and torch.cuda.is_current_stream_capturing():
        return True  # nothing can be looked at
    try:
        with torch.no_grad():
            return agree(found, _run_at_once(module, call, layout, grouping, memory, None))
    except Exception as error:  # what else it fails on now is found out where it runs next
        return _is_memory(error)


def _run_plan(plan: Plan, call: Call, layout: Layout, grouping: Grouping) -> Any:
    inputs: list[Tensor] = []
    call.arranged(Reordering(layout, None, inputs.append))
    result = plan.run(inputs, grouping)
    if len(layout.lead) == 1:
        return result
    number = itertools.count()

    def restore(rows: Tensor) -> Tensor:
        return layout.restore(rows, next(number)) if rows.shape[0] == layout.n else rows

    return map_result(result, restore)


def _run_at_once(
    module: nn.Module,
    call: Call,
    layout: Layout,
    grouping: Grouping,
    memory: Memory,
    recorder: Recorder | None,
    place: Callable[[Tensor, int], Any] | None = None,
) -> Any:
    place = place or (lambda rows, number: _in_original_order(rows, number, layout, grouping))
    parts = grouping.parts(memory.rows_at_once(module)) if grouping.device.type == "cpu" else [grouping]
    results: list[_Result] = []
    for part in parts:
        results.append(_run_part(module, call, layout, part, memory, recorder if not results else None))
    if len(parts) == 1:
        rows = [[tensor] for tensor in results[0].rows]
    else:
        rows = [list(pieces) for pieces in zip(*[result.rows for result in results], strict=True)]
    number = itertools.count()
    whole = iter([pieces[0] if len(pieces) == 1 else torch.cat(pieces) for pieces in rows])
    return map_result(results[0].value, lambda slot: place(next(whole), next(number)), leaf=_Slot)


class _Slot:
    """The place of a tensor of rows in a result."""


@dataclass(frozen=True)
class _Result:
    """What a module returned for a part of the rows: tensors of rows, and the structure they stand in."""

    rows: list[Tensor]
    value: Any


def _run_part(
    module: nn.Module, call: Call, layout: Layout, part: Grouping, memory: Memory, recorder: Recorder | None
) -> _Result:
    mode = RowMode(part, memory, recorder)

    def mark(tensor: Tensor) -> None:
        mode.mark(tensor)
        if recorder is not None:
            recorder.input(tensor)

    args, kwargs = call.arranged(Reordering(layout, part, mark))
    if recorder is not None:
        known = {id(tensor) for tensor in call.same_for_all(layout)}
        if any(mode.mark_of(tensor) is None and id(tensor) not in known for tensor in tensors_of([args, kwargs])):
            recorder.refuse("a tensor inside of an argument that is the same for all samples")
    stand_ins = as_per_cell(module)

    @contextlib.contextmanager
    def again() -> Iterator[Callable[[Tensor], Any]]:
        with in_place_of_parameters(module, stand_ins), RowMode(part, memory) as second:
            yield second.mark

    with in_place_of_parameters(module, stand_ins), rerun_in(again, mode.is_rows), mode:
        result = call.function(*args, **kwargs)
    if mode.failed:
        raise Ungroupable(mode.failed)
    if recorder is not None:
        recorder.finish(result)
    rows: list[Tensor] = []

    def finish(tensor: Tensor) -> Any:
        if isinstance(tensor, PerCell):
            raise Ungroupable("a result is made of parameters alone, and belongs to no sample")
        mark = mode.mark_of(tensor)
        if mark is None:
            if tensor.shape[:1] == (part.n,):
                raise Ungroupable("a result has a row for each sample, by a way that cannot be followed")
            return tensor
        if mark.lost:
            raise Ungroupable(f"after {mark.lost} rows are no longer single samples")
        rows.append(tensor)
        return _Slot()

    return _Result(rows, map_result(result, finish))


def _run_by_cell(
    module: nn.Module,
    call: Call,
    layout: Layout,
    grouping: Grouping,
    memory: Memory,
    kind: Any,
    place: Callable[[Tensor, int], Any] | None = None,
) -> Any:
    place = place or (lambda rows, number: _in_original_order(rows, number, layout, grouping))
    seen: list[Tensor] = []
    args, kwargs = call.arranged(Reordering(layout, grouping, seen.append))
    rows = {id(tensor) for tensor in seen}
    result, checked = run_cells(
        module, call.function, args, kwargs, grouping, lambda t: id(t) in rows, kind not in memory.separate
    )
    if checked:
        memory.separate.add(kind)
    number = itertools.count()
    return map_result(result, lambda tensor: place(tensor, next(number)))


def _in_original_order(rows: Tensor, number: int, layout: Layout, grouping: Grouping) -> Tensor:
    """A result's rows [n * m, ...] as the caller's leading dimensions say."""
    m = rows.shape[0] // grouping.n
    if m > 1:
        rows = rows.reshape(grouping.n, m, *rows.shape[1:])
    rows = grouping.unsort(rows)[: layout.n]
    return rows.reshape(layout.n * m, *rows.shape[2:]) if m > 1 else layout.restore(rows, number)
