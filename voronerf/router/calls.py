"""One call of a routed module: where its samples are, and how the module is run on them.

n samples in leading dimensions such as (rays, samples of a ray).
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.arguments import Layout, Reordering, argument_names, map_result
from voronerf.router.grouping import Grouping, PerCell
from voronerf.router.loop import run_cells
from voronerf.router.parameters import as_per_cell, in_place_of_parameters
from voronerf.router.rows import RowMode, Trials, Ungroupable

_OP = "VoronoiRouter"


class Assignments:
    """The last assignment, for other methods that are called with the same positions."""

    def __init__(self) -> None:
        self._key: tuple[Any, ...] = ()
        self._source: weakref.ref[Tensor] | None = None
        self._version = 0
        self._positions: Tensor | None = None
        self._methods: set[str] = set()
        self._grouping: Grouping | None = None

    def find(self, method: str, source: Tensor | None, positions: Tensor, key: tuple[Any, ...]) -> Grouping | None:
        """The assignment made for the same positions, or None. One that was drawn serves each method once.

        Args:
            method: that is called.
            source: the tensor that holds the positions, or None where they have been computed.
            positions: [..., 3].
            key: what else the assignment depends on.
        """
        if self._grouping is None or key != self._key or positions.numel() == 0:
            return None
        if source is not None:
            known = self._source is not None and self._source() is source and source._version == self._version
        else:
            known = (
                self._positions is not None
                and self._positions.shape == positions.shape
                and self._positions.device == positions.device
                and torch.equal(self._positions, positions)
            )
        drawn = key[2]
        if not known or (drawn and method in self._methods):
            return None
        self._methods.add(method)
        return self._grouping

    def keep(
        self, method: str, source: Tensor | None, positions: Tensor, key: tuple[Any, ...], grouping: Grouping
    ) -> None:
        """Remembers an assignment."""
        if source is not None and source.is_inference():  # has no version that would tell of changes
            self._grouping = None
            return
        self._key, self._methods, self._grouping = key, {method}, grouping
        self._source = None if source is None else weakref.ref(source)
        self._version = 0 if source is None else source._version
        self._positions = positions.detach().clone() if source is None else None


class Memory(Trials):
    """What a router remembers between calls. Copies of a router begin anew.

    Attributes:
        assignments: the last one.
        by_cell: why calls of a kind have to run cell by cell, once that is known.
        separate: the kinds of calls that have been found to treat samples one by one.
    """

    def __init__(self) -> None:
        super().__init__()
        self.forget()

    def forget(self) -> None:
        """Begins anew, after a change of diagram, dtype or device."""
        self.assignments = Assignments()
        self.by_cell: dict[Any, str] = {}
        self.separate: set[Any] = set()

    def __deepcopy__(self, memo: Any) -> Memory:
        return Memory()

    def __reduce__(self) -> tuple[type[Memory], tuple[()]]:
        return Memory, ()


class Call:
    """A method of the module with the arguments of one call.

    Attributes:
        method: its name.
        function: the bound method.
        args, kwargs: as they came.
        names: of the positional arguments.
    """

    def __init__(
        self, method: str, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> None:
        self.method, self.function, self.args, self.kwargs = method, function, args, kwargs
        self.names = argument_names(function, len(args))

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

    def kind(self, layout: Layout, training: bool) -> Any:
        """What decides how calls are carried out: arguments without the number of samples."""

        def describe(value: Any) -> Any:
            if isinstance(value, Tensor):
                return tuple(value.shape[len(layout.lead) - 1 :][1:]), value.dim(), value.dtype
            if isinstance(value, (bool, int, str, type(None))):
                return value
            return type(value)

        parts = [describe(value) for value in (*self.args, *self.kwargs.values())]
        return (self.method, training, len(layout.lead), tuple(self.kwargs), *parts)


def run_grouped(module: nn.Module, call: Call, layout: Layout, grouping: Grouping, memory: Memory) -> Any:
    """Runs a module for all cells, in one pass where that is possible.

    Args:
        module: with stacked parameters.
        call: of a method of it.
        layout: of the arguments.
        grouping: of the samples; of two rows where there are fewer samples.
        memory: of the router.
    """
    kind = call.kind(layout, module.training)
    if kind in memory.by_cell:
        return _run_by_cell(module, call, layout, grouping, memory, kind)
    try:
        return _run_at_once(module, call, layout, grouping, memory)
    except Ungroupable as error:
        reason, failure = str(error), None
    except Exception as error:
        if str(error).startswith(_OP):
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


def _run_at_once(module: nn.Module, call: Call, layout: Layout, grouping: Grouping, memory: Memory) -> Any:
    mode = RowMode(grouping, memory)
    args, kwargs = call.arranged(Reordering(layout, grouping, mode.mark))
    with in_place_of_parameters(module, as_per_cell(module)), mode:
        result = call.function(*args, **kwargs)
    if mode.failed:
        raise Ungroupable(mode.failed)

    def finish(tensor: Tensor) -> Tensor:
        if isinstance(tensor, PerCell):
            raise Ungroupable("a result is made of parameters alone, and belongs to no sample")
        mark = mode.mark_of(tensor)
        if mark is None:
            if tensor.shape[:1] == (grouping.n,):
                raise Ungroupable("a result has a row for each sample, by a way that cannot be followed")
            return tensor
        if mark.lost:
            raise Ungroupable(f"after {mark.lost} rows are no longer single samples")
        return _in_original_order(tensor, layout, grouping)

    return map_result(result, finish)


def _run_by_cell(module: nn.Module, call: Call, layout: Layout, grouping: Grouping, memory: Memory, kind: Any) -> Any:
    seen: list[Tensor] = []
    args, kwargs = call.arranged(Reordering(layout, grouping, seen.append))
    rows = {id(tensor) for tensor in seen}
    result, checked = run_cells(
        module, call.function, args, kwargs, grouping, lambda t: id(t) in rows, kind not in memory.separate
    )
    if checked:
        memory.separate.add(kind)
    return map_result(result, lambda tensor: _in_original_order(tensor, layout, grouping))


def _in_original_order(rows: Tensor, layout: Layout, grouping: Grouping) -> Tensor:
    """A result's rows [n * m, ...] as the caller's leading dimensions say."""
    m = rows.shape[0] // grouping.n
    if m > 1:
        rows = rows.reshape(grouping.n, m, *rows.shape[1:])
    rows = grouping.unsort(rows)[: layout.n]
    return rows.reshape(layout.n * m, *rows.shape[2:]) if m > 1 else layout.restore(rows)
