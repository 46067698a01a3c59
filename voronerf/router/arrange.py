"""The arguments of a routed call: the positions or labels that choose the cells of its samples, and their layout.

Letters: n samples, k cells, d coordinates.
"""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.router.labels import Labels
from voronerf.router.layout import AS_TENSOR, Call, Layout, as_plain
from voronerf.router.transforms import outside, unwrapped

_OP = "VoronoiRouter"
COLUMNS = {f"first{d}": d for d in range(1, 5)}  # the number of features that a rule for positions names
_LARGE = 512  # minimum number of samples for a check of the positions
_MANY = 4  # minimum number of cells for the warning that one cell has nearly all samples


def with_labels(
    router: Any, method: str, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | None, cells: Any
) -> tuple[tuple[Any, ...], dict[str, Any], Tensor | Labels | None]:
    """Returns args, kwargs and the labels ``cells``; or ``coords``, if the method itself has an argument ``cells``."""
    names = router._argument_names.get(method, ())
    if coords is not None and "coords" in names:
        kwargs, coords = {**kwargs, "coords": coords}, None
    if "cells" in names:
        return args, {**kwargs, "cells": cells}, coords
    if coords is not None:
        raise ValueError(f"{_OP}: coords must be None where cells are given, got both")
    labels = Labels.of(cells, router.num_cells, router.diagram.centres.device)
    return args if router.shared or router.per_ray else labels.widen(args, kwargs), kwargs, labels


def find_positions(router: Any, args: Sequence[Any], kwargs: dict[str, Any], coords: Tensor | Labels | None) -> Tensor:
    """Returns the positions [..., d] that choose the cells of a call, or its labels, int32 [..., 1].

    Args:
        router: The router.
        args: The positional arguments of the call.
        kwargs: The keyword arguments of the call.
        coords: The positions or labels of the call; None if the router's own rule finds the positions.
    """
    rule: Any = router.coords if coords is None else coords
    if type(rule) is Labels:
        return rule.cells
    source, is_whole, d = None, False, router._modules["diagram"]._buffers["centres"].shape[1]
    if not d:
        raise ValueError(
            f"{_OP}: cells must be given to each call of a router without centres: pass cells=labels, integers of the "
            "leading shape of the samples"
        )
    if type(rule) is str or isinstance(rule, slice):
        is_first = args and type(args[0]) is Tensor and args[0].dim()  # the usual case
        source = args[0] if is_first else _first_tensor(args, kwargs)
        if source is None:
            got = ", ".join(type(value).__name__ for value in (*args, *kwargs.values())) or "nothing"
            raise ValueError(
                f"{_OP}: coords={rule!r} must find a tensor among the arguments, got {got}; {AS_TENSOR}, or as "
                "coords a function of the arguments"
            )
        columns: Any = COLUMNS[rule] if isinstance(rule, str) else rule
        is_whole = source.shape[-1] == d == columns
        positions = source if is_whole else source[..., columns if isinstance(columns, slice) else slice(columns)]
    elif isinstance(rule, Tensor):
        positions = as_plain(rule)
    elif callable(rule):
        positions = as_plain(rule(*args, **kwargs))
    elif rule is None:
        raise ValueError(
            f"{_OP}: coords must name the positions among the module's arguments: pass coords='first{d}', a slice of "
            f"the features or a function of the arguments to the router, or coords=positions [..., {d}] to this call"
        )
    else:
        raise TypeError(f"{_OP}: coords must be a tensor, got {type(rule).__name__}; {AS_TENSOR}")
    is_row = is_whole or (isinstance(positions, Tensor) and positions.shape[-1:] == (d,))
    if not is_row or not positions.is_floating_point():
        what = "coords" if isinstance(rule, Tensor) else "the result of coords"
        if source is not None:
            what = f"coords={rule!r} of the first tensor, {list(source.shape)},"
        if not isinstance(positions, Tensor):
            raise TypeError(f"{_OP}: {what} must be a tensor, got {type(positions).__name__}")
        if not is_row:
            raise ValueError(f"{_OP}: {what} must have shape [..., {d}], got {list(positions.shape)}")
        raise TypeError(f"{_OP}: {what} must be floating-point, got {positions.dtype}")
    if router._positions_unchecked and torch.is_grad_enabled() and not torch.compiler.is_compiling():
        _check_positions(router, positions, source, rule)
    return positions


def _check_positions(router: Any, positions: Tensor, source: Tensor | None, rule: Any) -> None:
    """Warns, at the first large batch of training, if the positions look like another quantity or unit."""
    if positions.numel() < _LARGE * positions.shape[-1]:
        return
    router._positions_unchecked = False
    with outside():
        flat, diagram = unwrapped(positions).detach().flatten(0, -2), router.diagram
        counts = diagram.locate(flat, backend=router.backend).bincount(minlength=diagram.num_cells)
        warning = _position_warning(rule, source, flat, counts, diagram.centres)
    if warning:
        router._dispatch.warn_once("positions", warning)


@torch.no_grad()
def _position_warning(coords: Any, source: Tensor | None, flat: Tensor, counts: Tensor, centres: Tensor) -> str:
    """Returns the reason why positions [n, d] may be another quantity, or an empty text.

    ``source`` is the tensor in which ``coords`` finds the positions; ``counts`` [k] are the samples in each cell.
    """
    k, d = len(counts), flat.shape[1]
    if isinstance(coords, str) and source is not None:
        x = unwrapped(source).detach().flatten(0, -2)[:256].float()
        circle = (x[:, :1].square() + x.square() - 1).abs().amax(0) < 1e-3
        if x.shape[1] > d and float(x[:, 0].std()) > 1e-3 and bool(circle.any()):
            return (
                f"coords={coords!r} takes sines and cosines of an encoding for positions; let the encoding begin with "
                "the position, or pass coords=positions to each call"
            )
        if d == 3 and float((x[:, :3].norm(dim=1) - 1).abs().max()) < 1e-3:
            return f"coords={coords!r} takes unit vectors, such as directions, for positions; pass coords=positions"
    most = int(counts.max())
    if k < _MANY or most <= 0.9 * len(flat):
        return ""
    spans = (f"{float(x.min()):.3g} to {float(x.max()):.3g}" for x in (centres, flat))
    return (
        f"{most:,} of {len(flat):,} samples are in one of {k} cells; centres (coordinates {next(spans)}) must be in "
        f"the units of positions ({next(spans)}): VoronoiDiagram.from_points(positions, {k}) places them"
    )


def describe_call(router: Any, method: str, positions: Tensor, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Call:
    """Describes a call of a method, for samples at positions [..., d] or with labels, int32 [..., 1]."""
    positional = argument_names(getattr(router.module, method))
    names = [*positional[: len(args)], *map(str, range(len(positional), len(args)))]

    def named(items: Iterable[Any]) -> frozenset[str]:
        return frozenset(names[item] if type(item) is int and item < len(names) else str(item) for item in items)

    per_ray = None if router.per_ray is None else named(router.per_ray)
    layout = Layout(tuple(positions.shape[:-1]), per_ray, named(router.shared), router.layout == "flat")
    return Call(router.module, method, layout, [*names, *kwargs], args, kwargs)


def _first_tensor(args: Sequence[Any], kwargs: dict[str, Any]) -> Tensor | None:
    """Returns the first tensor among the arguments of a call, or None."""
    for value in (*args, *kwargs.values()) if kwargs else args:
        if isinstance(value, Tensor) and value.dim():
            return value if type(value) is Tensor else as_plain(value)
    return None


def argument_names(function: Callable[..., Any]) -> list[str]:
    """Returns the names of a function's positional arguments; for methods they are cached."""
    return list(
        _names(function.__func__)[1:] if isinstance(function, types.MethodType) else _names.__wrapped__(function)
    )


@functools.lru_cache(maxsize=256)
def _names(function: Callable[..., Any]) -> list[str]:
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [parameter.name for parameter in inspect.signature(function).parameters.values() if parameter.kind in kinds]


def accepted_names(functions: Iterable[Callable[..., Any]]) -> list[str] | None:
    """Returns the names of all arguments of some functions; None if one of them takes any keyword."""
    parameters = [p for function in functions for p in inspect.signature(function).parameters.values()]
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters):
        return None
    return list(dict.fromkeys(p.name for p in parameters))
