"""A routed call as one operation in a graph of ``torch.compile`` or ``torch.export``.

The operation runs the router as it is, and its backward runs the call again. It is for routers with ``fuse=True``,
whose ``forward`` does the same in every call, after one call outside of the graph, which says what it returns.
"""

from __future__ import annotations

import ast
import contextlib
import itertools
import weakref
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from voronerf.ops._core.compiler import constant_result
from voronerf.router.double import Double
from voronerf.router.layout import Layout, tensors_of

_ROUTERS: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
_NUMBERS = itertools.count()
_PLAIN = (type(None), bool, int, float, str)
Spec = tuple[Any, ...]  # of an argument: ("tensor",) or ("plain", value), with names in front of keyword arguments


class Graph(NamedTuple):
    """What a call returns: tuples, lists and dicts of numbers of tensors; features and dtype of each tensor."""

    structure: Any
    tensors: list[tuple[tuple[int, ...], torch.dtype]]


def number_of(router: nn.Module) -> int:
    """A new number, by which the operation finds a router."""
    number = next(_NUMBERS)
    _ROUTERS[number] = router
    return number


def graph_of(result: Any, layout: Layout) -> Graph | None:
    """The graph of a call with this result, or None unless it holds tensors in tuples, lists and dicts only."""
    found, count = tensors_of(result), itertools.count()
    structure, lead = _structure(result, count), 1 if layout.flat else len(layout.lead)
    if structure is None or next(count) != len(found):
        return None
    return Graph(structure, [(tuple(t.shape[lead:]), t.dtype) for t in found])


def spec_of(args: Any, kwargs: Any) -> Spec | None:
    """A call without its tensors, or None if an argument is no tensor, number, string or None."""
    spec: list[Any] = []
    for name, value in [*[(None, value) for value in args], *kwargs.items()]:
        if isinstance(value, Tensor):
            spec.append((name, "tensor"))
        elif isinstance(value, _PLAIN):
            spec.append((name, "plain", value))
        else:
            return None
    return tuple(spec)


def _structure(value: Any, count: Iterator[int]) -> Any:
    """Numbers of the tensors in a result of tensors, tuples, lists and dicts; None for any other."""
    if isinstance(value, Tensor):
        return next(count)
    if type(value) not in (tuple, list, dict):
        return None
    keys = tuple(value) if isinstance(value, dict) else None
    parts = tuple(_structure(item, count) for item in (value.values() if isinstance(value, dict) else value))
    plain = keys is None or all(isinstance(key, str) for key in keys)
    return (type(value).__name__, keys, parts) if plain and None not in parts else None


def built(structure: Any, tensors: list[Tensor]) -> Any:
    """The result that a structure stands for."""
    if isinstance(structure, int):
        return tensors[structure]
    kind, keys, parts = structure
    items = [built(part, tensors) for part in parts]
    return dict(zip(keys, items)) if kind == "dict" else tuple(items) if kind == "tuple" else items


@constant_result
def structure_of(number: int, method: str, spec: Spec) -> Any:
    """The structure of a call's results; None for a call that is not known."""
    graph = _ROUTERS[number]._dispatch.graphs.get((method, spec))
    return None if graph is None else graph.structure


def _call(
    number: int, method: str, spec: str, positions: Tensor, tensors: list[Tensor], parameters: list[Tensor]
) -> list[Tensor]:
    """The tensors that a call of a router returns, with other parameters; ``spec`` is its ``repr``."""
    router, following = _ROUTERS[number], iter(tensors)
    args, kwargs = [], {}
    for name, _, *plain in ast.literal_eval(spec):
        value = plain[0] if plain else next(following)
        if name is None:
            args.append(value)
        else:
            kwargs[name] = value
    double = Double(router.module)
    double.fill({id(own): given for own, given in zip(router.module.parameters(), parameters, strict=True)})
    return tensors_of(router._call(double.module, method, positions, tuple(args), kwargs))


@torch.library.custom_op("voronerf::routed", mutates_args=())
def _routed(
    number: int, method: str, spec: str, positions: Tensor, tensors: list[Tensor], parameters: list[Tensor]
) -> list[Tensor]:
    with torch.no_grad():
        return [t.clone() for t in _call(number, method, spec, positions, tensors, parameters)]


@_routed.register_fake
def _(number: int, method: str, spec: str, positions: Tensor, *tensors: list[Tensor]) -> list[Tensor]:
    shapes = _ROUTERS[number]._dispatch.graphs[method, ast.literal_eval(spec)].tensors
    return [positions.new_empty((*positions.shape[:-1], *features), dtype=dtype) for features, dtype in shapes]


@torch.library.custom_op("voronerf::routed_backward", mutates_args=())
def _routed_backward(
    number: int,
    method: str,
    spec: str,
    positions: Tensor,
    tensors: list[Tensor],
    parameters: list[Tensor],
    gradients: list[Tensor],
) -> list[Tensor]:
    with _recorded():
        leaves = [t.detach().requires_grad_(t.is_floating_point() or t.is_complex()) for t in (*tensors, *parameters)]
        found = _call(number, method, spec, positions, leaves[: len(tensors)], leaves[len(tensors) :])
        linked = [(t, g) for t, g in zip(found, gradients, strict=True) if t.requires_grad]
        wanted = [leaf for leaf in leaves if leaf.requires_grad]
        results, weights = [t for t, _ in linked], [g for _, g in linked]
        made = iter(torch.autograd.grad(results, wanted, weights, allow_unused=True))
    given = [next(made) if leaf.requires_grad else None for leaf in leaves]
    return [torch.zeros_like(leaf) if g is None else g.clone() for g, leaf in zip(given, leaves, strict=True)]


_routed_backward.register_fake(
    lambda number, method, spec, positions, tensors, parameters, gradients: [
        torch.empty_like(t) for t in (*tensors, *parameters)
    ]
)


@contextlib.contextmanager
def _recorded() -> Iterator[None]:
    """Lets autograd record inside of an operation, which PyTorch runs below it."""
    keys = (torch._C.DispatchKey.AutogradFunctionality, torch._C.DispatchKey.ADInplaceOrView)
    with contextlib.ExitStack() as stack:
        for key in keys:
            stack.enter_context(torch._C._SetExcludeDispatchKeyGuard(key, False))
        stack.enter_context(torch.enable_grad())
        yield


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.call, (positions, tensors, parameters) = inputs[:3], inputs[3:]
    ctx.count = len(tensors)
    ctx.save_for_backward(positions, *tensors, *parameters)


def _backward(ctx: Any, gradients: list[Tensor]) -> Any:
    positions, *others = ctx.saved_tensors
    found = torch.ops.voronerf.routed_backward(
        *ctx.call, positions, others[: ctx.count], others[ctx.count :], [g.contiguous() for g in gradients]
    )
    needed = [g if t.is_floating_point() or t.is_complex() else None for g, t in zip(found, others, strict=True)]
    return None, None, None, None, needed[: ctx.count], needed[ctx.count :]


_routed.register_autograd(_backward, setup_context=_save)
