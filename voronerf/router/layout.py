"""How a call's arguments relate to its samples, and how they are brought into another order and back.

Letters: n samples in leading dimensions ``lead``, for example (rays, samples of a ray); f features.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.grouping import Grouping
from voronerf.router.trees import Change, map_children, map_tree, tensors_of

_OP = "VoronoiRouter"
SAMPLE, RAY, BROADCAST, SHARED = "sample", "ray", "broadcast", "shared"


# Layouts --------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Layout:
    """How the tensors of a call are laid out, and what the module sees of them.

    A module of layout "flat" sees [n, f] for every argument with rows. One of layout "rays" sees [n, 1, f] for
    [rays, samples, f] and [n, f] for what is per ray: n rays of one sample. A call of one ray, [1, samples, f], stays
    one ray: the module sees [1, n, f], and what is per ray is passed on.

    Attributes:
        lead: Leading dimensions of a tensor with an entry for each sample.
        per_ray: Names of the arguments with an entry for each ray, or None to tell by shapes.
        shared: Names of the arguments that are the same for all samples.
        flat: Whether the module sees [n, f].
    """

    lead: tuple[int, ...]
    per_ray: frozenset[str] | None
    shared: frozenset[str]
    flat: bool = False

    @property
    def n(self) -> int:
        """Samples."""
        return math.prod(self.lead)

    @property
    def one_ray(self) -> bool:
        """Whether the module sees [1, n, f]."""
        return not self.flat and len(self.lead) > 1 and self.lead[-1] > 1 and math.prod(self.lead[:-1]) == 1

    @property
    def axis(self) -> int:
        """The dimension of the rows in what the module sees."""
        return len(self.lead) - 1 if self.one_ray else 0

    def kind(self, name: str, tensor: Tensor, nested: bool) -> str:
        """What a tensor has an entry for: each sample, each ray, or neither.

        Args:
            name: Of the argument; of an attribute of it, "argument.attribute".
            tensor: The argument.
            nested: Inside an object, where what fits nothing is left alone.

        Raises:
            ValueError: For a tensor that fits nothing, or two readings.
        """
        shape, lead, d = tuple(tensor.shape), self.lead, len(self.lead)
        if not shape or _named(name, self.shared):
            return SHARED
        by_sample = shape[:d] == lead
        by_ray = d >= 2 and shape[: d - 1] == lead[:-1] and len(shape) in (d - 1, d)
        if self.per_ray is not None and _named(name, self.per_ray):
            if d < 2 or shape[: d - 1] != lead[:-1]:
                raise ValueError(
                    f"{_OP}: {name} is per ray and must have shape [{_sizes(lead[:-1], 'rays')}, ...] beside samples "
                    f"of [{_sizes(lead)}, ...], got {list(shape)}"
                )
            return RAY
        if self.per_ray is None and by_ray and self.n and lead[-1] > 1 and (by_sample or lead[-1] == lead[-2]):
            other = f"each of {lead[-1]} samples" if by_sample else "a sample's place along every ray"
            raise ValueError(
                f"{_OP}: per_ray must say what {name} is, since [{_sizes(shape)}] beside samples of "
                f"[{_sizes(lead)}, ...] may stand for rays or for {other}; pass per_ray=[{name!r}], or per_ray=[] if "
                "it is not per ray"
            )
        if by_sample:
            return SAMPLE
        if by_ray and self.per_ray is None:
            return RAY
        if tensor.numel() == 1 or all(size == 1 for size in shape[:d]):
            return SHARED
        if len(shape) >= d and all(size in (1, whole) for size, whole in zip(shape, lead)):
            return BROADCAST
        if nested:
            return SHARED
        ray = f", per ray [{_sizes(lead[:-1])}, ...]" if d >= 2 else ""
        raise ValueError(
            f"{_OP}: {name} must be per sample [{_sizes(lead)}, ...]{ray}, or named in shared=, got {list(shape)}"
        )

    def flatten(self, tensor: Tensor, kind: str) -> Tensor:
        """[n, ...] of a tensor per sample, [rays, ...] of one per ray."""
        d = len(self.lead)
        if kind == RAY:
            return tensor.reshape(math.prod(self.lead[:-1]), *tensor.shape[d - 1 :])
        if kind == BROADCAST:
            tensor = tensor.expand(*self.lead, *tensor.shape[d:])
        return tensor.reshape(self.n, *tensor.shape[d:])

    def shown(self, rows: Tensor, kind: str) -> Tensor:
        """Rows [n, ...] as the module sees them."""
        if self.flat or len(self.lead) == 1:
            return rows
        ones = [1] * (len(self.lead) - (2 if kind == RAY else 1))
        if self.one_ray:
            return rows.reshape(*ones, *rows.shape)
        return rows.reshape(rows.shape[0], *ones, *rows.shape[1:]) if ones else rows

    def rows_of(self, result: Tensor) -> Tensor:
        """A result of the module as rows [n * m, ...]."""
        axis = self.axis
        kept = axis and result.dim() > axis and all(size == 1 for size in result.shape[:axis])
        return result.reshape(result.shape[axis:]) if kept else result

    def restore(self, rows: Tensor, flattened: bool) -> Tensor:
        """Rows of a result in the original order, with the leading dimensions of the call.

        Args:
            rows: [n * m, ...], from [n, 1, ...] with its dimension of one.
            flattened: Whether the module itself makes [rays * samples, ...] of what it gets.
        """
        n, rest = self.n, rows.shape[1:]
        if len(self.lead) == 1 or flattened or (n and rows.shape[0] != n):
            return rows
        ones = 0 if self.flat or self.one_ray else len(self.lead) - 1
        dropped = next((i for i, size in enumerate(rest[:ones]) if size != 1), min(ones, len(rest)))
        return rows.reshape(*self.lead, *rest[dropped:])


def _named(name: str, names: Iterable[str]) -> bool:
    return any(name == known or name.startswith(f"{known}.") for known in names)


def _sizes(shape: Sequence[int], empty: str = "") -> str:
    return ", ".join(str(size) for size in shape) or empty


# Calls ----------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Given:
    """Arguments as a module sees them, sorted by cell, and the tensors among them that have rows."""

    args: Sequence[Any]
    kwargs: dict[str, Any]
    rows: list[Tensor]

    def part(self, first: int, last: int, axis: int) -> Given:
        """Rows ``first`` to ``last`` alone."""
        rows = {id(tensor) for tensor in self.rows}
        found: list[Tensor] = []

        def cut(name: str, value: Any, nested: bool) -> Any:
            if not isinstance(value, Tensor):
                if not any(id(tensor) in rows for tensor in tensors_of(value)):
                    return value
                value = value[(slice(None),) * axis + (slice(first, last),)]
                found.extend(tensors_of(value))
                return value
            if id(value) not in rows:
                return value
            found.append(value.narrow(axis, first, last - first))
            return found[-1]

        args, kwargs = map_tree((tuple(self.args), self.kwargs), cut, batches=True)
        return Given(args, kwargs, found)


@dataclasses.dataclass
class Call:
    """A method of a module with the arguments of one call, their layout, and their names, of positional ones first."""

    module: nn.Module
    method: str
    layout: Layout
    names: list[str]
    args: tuple[Any, ...]
    kwargs: dict[str, Any]

    def run(self, given: Given) -> Any:
        """Calls the method; ``forward`` by way of the module, whose hooks run then."""
        method = self.module if self.method == "forward" else getattr(self.module, self.method)
        return method(*given.args, **given.kwargs)

    @property
    def name(self) -> str:
        """Of the method, for messages."""
        return f"{type(self.module).__name__}.{self.method}"

    def arranged(self, grouping: Grouping | None) -> Given:
        """The arguments as the module sees them, in the order of a grouping; None keeps the original order."""
        order = _Order(self.layout, grouping)
        return dataclasses.replace(self.changed(order.change), rows=order.found)

    def changed(self, change: Change) -> Given:
        """The arguments with every tensor and batch-like object changed, see :func:`map_tree`."""
        values = [
            map_tree(value, change, name, batches=True)
            for name, value in zip(self.names, (*self.args, *self.kwargs.values()), strict=True)
        ]
        return Given(values[: len(self.args)], dict(zip(self.kwargs, values[len(self.args) :])), [])


class _Order:
    """Brings tensors and batch-like objects into the order of a grouping."""

    def __init__(self, layout: Layout, grouping: Grouping | None) -> None:
        self.layout, self.grouping = layout, grouping
        self.n = layout.n if grouping is None else grouping.n
        self.found: list[Tensor] = []
        self._rays: Tensor | None = None

    def change(self, name: str, value: Any, nested: bool) -> Any:
        if not isinstance(value, Tensor):
            return self._batch(name, value)
        kind = self.layout.kind(name, value, nested)
        if kind == SHARED or (kind == RAY and self.layout.one_ray):
            return value
        rows = self.layout.shown(self._rows(self.layout.flatten(value, kind), kind == RAY), kind)
        self.found.append(rows)
        return rows

    def _rows(self, flat: Tensor, ray: bool) -> Tensor:
        if not self.layout.n:  # a module that is never called without rows gives its sizes on placeholders
            empty = flat.new_full((self.n, *flat.shape[1:]), 0.5 if flat.is_floating_point() else 0)
            return torch.cat([flat[:0], empty])  # joined, so that results depend on the argument as ever
        if ray:
            return flat.index_select(0, self._ray_of_rows(flat.device))
        rows = flat if self.grouping is None else self.grouping.sort(flat)
        return rows.view_as(rows) if rows is flat else rows  # an object of its own, to be told apart

    def _ray_of_rows(self, device: torch.device) -> Tensor:
        if self._rays is None:
            grouping = self.grouping or Grouping(None, self.n, 1, device, "auto")
            self._rays = grouping.rays(self.layout.lead[-1])
        return self._rays

    def _batch(self, name: str, value: Any) -> Any:
        """An object that can be flattened, indexed and reshaped as a whole."""
        layout, shape = self.layout, tuple(value.shape)
        if shape not in (layout.lead, layout.lead[:-1]) or not shape or (layout.one_ray and shape != layout.lead):
            return value
        if not layout.n:
            return map_children(value, self.change, name)
        flat, device = value.flatten(), next((t.device for t in tensors_of(value)), torch.device("cpu"))
        if shape != layout.lead:
            flat = flat[self._ray_of_rows(device).long()]
        elif self.grouping is not None:
            flat = flat[self.grouping.sort(torch.arange(layout.n, device=device))]
        ones = () if layout.flat else (1,) * (len(shape) - 1)
        rows = flat.reshape((*ones, self.n) if layout.one_ray else (self.n, *ones)) if ones else flat
        axis = layout.axis
        self.found += [t for t in tensors_of(rows) if t.dim() > axis and t.shape[axis] == self.n]
        return rows


def find_positions(rule: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> tuple[Tensor, Tensor | None]:
    """The positions of a call's samples.

    Returns:
        Positions [..., 3], and the tensor whose identity stands for them, or None.

    Raises:
        ValueError: Where no rule is given, or it does not fit the arguments.
        TypeError: For positions that are no tensor.
    """
    if rule is None:
        raise ValueError(
            f"{_OP}: coords must say where the positions are, since a module's arguments do not: pass "
            "coords='first3', a slice of the features or a function of the arguments to the router, or "
            "coords=positions [..., 3] to this call"
        )
    source: Tensor | None
    if isinstance(rule, Tensor):
        positions, source, what = rule, rule, "coords"
    elif callable(rule):
        positions, source, what = rule(*args, **kwargs), None, "what coords returns"
    else:
        source = next((v for v in (*args, *kwargs.values()) if isinstance(v, Tensor)), None)
        if source is None:
            got = ", ".join(type(value).__name__ for value in (*args, *kwargs.values())) or "nothing"
            raise ValueError(
                f"{_OP}: coords={rule!r} must find a tensor among the arguments, got {got}; pass a function"
            )
        if source.dim() == 0:
            raise ValueError(f"{_OP}: coords={rule!r} must find features in the first tensor, got a number")
        positions = source[..., :3] if rule == "first3" else source[..., rule]
        what = f"what coords={rule!r} takes from the first tensor, {list(source.shape)},"
    if not isinstance(positions, Tensor):
        raise TypeError(f"{_OP}: {what} must be a tensor, got {type(positions).__name__}")
    if positions.dim() == 0 or positions.shape[-1] != 3 or not positions.is_floating_point():
        raise ValueError(
            f"{_OP}: {what} must have shape [..., 3] and a floating-point dtype, got {list(positions.shape)} of "
            f"{positions.dtype}"
        )
    return positions, source


def argument_names(function: Callable[..., Any], count: int) -> list[str]:
    """Names of the first positional arguments of a function; their numbers where it does not name them."""
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    names = [parameter.name for parameter in _signature(function) or () if parameter.kind in kinds]
    return [names[i] if i < len(names) else str(i) for i in range(count)]


def accepted_names(functions: Sequence[Callable[..., Any]]) -> list[str] | None:
    """The names of the arguments that any of some functions take; None where one takes any name."""
    names: dict[str, None] = {}
    for function in functions:
        parameters = _signature(function)
        if parameters is None or any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters):
            return None
        names |= dict.fromkeys(parameter.name for parameter in parameters)
    return list(names)


def _signature(function: Callable[..., Any]) -> list[inspect.Parameter] | None:
    try:
        return list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return None
