"""Compares a module of other code in VoronoiRouter with a loop over masks of distinct modules.

A new module needs only a :class:`Row`; :func:`compare` does the rest. n samples, k cells.
"""

from __future__ import annotations

import fnmatch
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves, tree_map_only

from voronerf import VoronoiRouter

N, K, SEED = 300, 4, 1
ROUNDED = 1e-4
"""If the float32 error of a module exceeds this value, the module is compared in float64, too."""
NO_PART = 1e-6
"""A tensor's error is divided by its size (its largest entry or its norm), or by this fraction of the largest tensor's
size, whichever is larger: a smaller tensor is zero except for rounding."""


def uniform(lead: tuple[int, ...], *shape: int) -> Tensor:
    """Returns numbers between -1 and 1, [*lead, *shape]."""
    return torch.rand(*lead, *shape) * 2 - 1


@dataclass(frozen=True)
class Row:
    """A module and how it is called.

    Attributes:
        module: The name in the results.
        make: A function that makes the module; its argument is the imported file, if there is one.
        inputs: The arguments: a number d stands for a tensor [n, d] of d features, a function makes an argument from
            the leading shape, everything else is passed on.
        method: The method that is called.
        keywords: Keyword arguments, in the form of ``inputs``.
        coords: A function of the arguments that returns positions; None for the first features of the first tensor.
        lead: The leading shape of the samples, (n,) or (rays, samples).
        options: Further options of the router.
        second: Whether the gradients of an eikonal loss, (|d y / d x| - 1)^2, are compared, too.
    """

    module: str
    make: Callable[..., nn.Module]
    inputs: tuple[Any, ...]
    method: str = "forward"
    keywords: Mapping[str, Any] = field(default_factory=dict)
    coords: Callable[..., Tensor] | None = None
    lead: tuple[int, ...] = (N,)
    options: Mapping[str, Any] = field(default_factory=dict)
    second: bool = False

    def arguments(self, dtype: torch.dtype) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Returns arguments and keyword arguments, whose float tensors require gradients."""

        def build(item: Any) -> Any:
            value = uniform(self.lead, item) if type(item) is int else item(self.lead) if callable(item) else item
            return tree_map_only(Tensor, leaf, value)

        def leaf(value: Tensor) -> Tensor:
            return value.to(dtype).requires_grad_() if value.is_floating_point() else value

        torch.manual_seed(SEED)
        return tuple(map(build, self.inputs)), {name: build(item) for name, item in self.keywords.items()}

    def modules(self, dtype: torch.dtype, imported: tuple[Any, ...]) -> list[nn.Module]:
        """Returns a module for each cell; the modules differ only in parameters that cells do not share."""
        modules: list[nn.Module] = []
        for cell in range(K):
            torch.manual_seed(SEED)
            np.random.seed(SEED)  # noqa: NPY002  constructors draw from it
            modules.append(module := self.make(*imported))
            for tensor in (*module.parameters(), *module.buffers()):
                if tensor.is_floating_point() or tensor.is_complex():
                    tensor.data = tensor.to(torch.promote_types(tensor.dtype, dtype))
            torch.manual_seed(SEED + cell)
            with torch.no_grad():
                for parameter in filter(lambda p: p.requires_grad, module.parameters()):
                    parameter += 0.1 * torch.randn_like(parameter) * parameter.abs().mean().clamp(0.01)
            for name in self.shared(modules[0]):
                path, _, last = name.rpartition(".")
                module.get_submodule(path).register_parameter(last, modules[0].get_parameter(name))
        return modules

    def shared(self, module: nn.Module) -> list[str]:
        """Returns the names of the parameters that all cells have in common."""
        patterns, names = self.options.get("share", ()), [name for name, _ in module.named_parameters()]
        return [name for name in names if any(fnmatch.fnmatch(name, pattern) for pattern in patterns)]

    def part(self, value: Tensor, rows: Tensor) -> Tensor:
        """Returns an argument's rows for some samples, as the router does; rows of rays are repeated per sample."""
        d = len(self.lead)
        if value.shape[:d] == self.lead:
            return value.flatten(0, d - 1)[rows].reshape(len(rows), *[1] * (d - 1), *value.shape[d:])
        return value[rows // self.lead[1]] if d > 1 and value.shape[:1] == self.lead[:1] else value


def compare(row: Row, *imported: Any) -> dict[str, Any]:
    """Returns how a module runs in the router and its largest errors, or why the router refuses it."""
    kind = type(row.make(*imported))
    found: dict[str, Any] = {"module": row.module, "class": f"{kind.__module__}.{kind.__qualname__}"}
    try:
        way, errors = _compared(row, torch.float32, imported)
    except Exception as error:
        return {**found, "how": f"refused: {_short(str(error) or type(error).__name__)}"}
    if max(errors.values()) > ROUNDED:
        torch.set_default_dtype(torch.float64)
        try:
            exact = _compared(row, torch.float64, imported)[1]
        finally:
            torch.set_default_dtype(torch.float32)
        errors |= {f"{name}_float64": error for name, error in exact.items()}
    return {**found, **way, **errors}


def _compared(row: Row, dtype: torch.dtype, imported: tuple[Any, ...]) -> tuple[dict[str, Any], dict[str, float]]:
    modules, (args, kwargs) = row.modules(dtype, imported), row.arguments(dtype)
    tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
    d = min(3, tensors[0].shape[-1])
    positions = row.coords(*args, **kwargs) if row.coords else tensors[0][..., :d]
    positions = positions.detach().flatten(0, len(row.lead) - 1)
    centres = uniform((K,), positions.shape[-1]).to(dtype)
    cells = (positions[:, None] - centres).square().sum(-1).argmin(1)
    methods = [row.method] * (row.method != "forward")
    options = {"coords": row.coords or f"first{d}", "methods": methods, **row.options}
    router = VoronoiRouter.from_modules(modules, centres, fuse=True, way="fused", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row already reports an unfused module
        for _ in range(2):  # the first call selects the evaluation path of the next call
            routed = _tensors(getattr(router, row.method)(*args, **kwargs))
    looped = _loop(row, modules, cells, args, kwargs)
    if [value.shape for value in routed] != [value.shape for value in looped]:
        raise ValueError(f"shapes {[list(v.shape) for v in routed]} instead of {[list(v.shape) for v in looped]}")

    inputs = [value for value in tensors if value.requires_grad]
    names, shared = [n for n, p in modules[0].named_parameters() if p.requires_grad], row.shared(modules[0])
    stacked = [router.module.get_parameter(name) for name in names]
    single = [[m.get_parameter(name) for m in modules[: 1 if name in shared else K]] for name in names]
    losses = {"gradient_error": _weighted, **({"second_derivative_error": _eikonal} if row.second else {})}
    errors = {"value_error": _error(routed, looped, lambda x: x.abs().max())}
    for name, loss in losses.items():
        got = _gradients(loss(routed, inputs), [*stacked, *inputs])
        right = iter(_gradients(loss(looped, inputs), [*[p for cells in single for p in cells], *inputs]))
        parts = [[next(right) for _ in cells] for cells in single]
        expected = [torch.stack(part) if len(part) > 1 else part[0] for part in parts]
        errors[name] = _error(got, [*expected, *right], torch.linalg.vector_norm)
    return _way(router, row.method), errors


def _loop(row: Row, modules: list[nn.Module], cells: Tensor, args: Any, kwargs: Any) -> list[Tensor]:
    """Runs the loop over masks: each module on the samples of its cell."""
    order, parts = [], []
    for cell, module in enumerate(modules):
        rows = (cells == cell).nonzero()[:, 0]
        if len(rows):
            part = tree_map_only(Tensor, lambda value, rows=rows: row.part(value, rows), (args, kwargs))
            order.append(rows)
            parts.append(_tensors(getattr(module, row.method)(*part[0], **part[1])))
    back, d = torch.cat(order).argsort(), len(row.lead)
    return [torch.cat(part)[back].reshape(*row.lead, *part[0].shape[d:]) for part in zip(*parts, strict=True)]


def _tensors(results: Any) -> list[Tensor]:
    """Returns the tensors of results; complex tensors as pairs of numbers."""
    tensors = [value for value in tree_leaves(results) if isinstance(value, Tensor)]
    return [torch.view_as_real(value) if value.is_complex() else value for value in tensors]


def _weighted(results: list[Tensor], _: list[Tensor]) -> Tensor:
    """Returns a loss in which each number of the results has a different weight."""
    torch.manual_seed(SEED)
    terms = [(value * torch.randn(value.shape).to(value)).sum() for value in results]
    return torch.stack([term for term in terms if term.requires_grad]).sum()


def _eikonal(results: list[Tensor], inputs: list[Tensor]) -> Tensor:
    (slope,) = torch.autograd.grad(results[0][..., 0].sum(), inputs[:1], create_graph=True)
    return (slope.norm(dim=-1) - 1).square().mean()


def _gradients(loss: Tensor, of: list[Tensor]) -> list[Tensor]:
    return list(torch.autograd.grad(loss, of, retain_graph=True, allow_unused=True, materialize_grads=True))


def _error(got: list[Tensor], right: list[Tensor], size: Callable[[Tensor], Tensor]) -> float:
    """Returns the largest relative error of the tensors."""
    sizes = [float(size(value.detach())) for value in right]
    least = max(NO_PART * max(sizes), 1e-30)
    errors = [float(size((a - b).detach())) / max(s, least) for a, b, s in zip(got, right, sizes, strict=True)]
    return float(f"{max(errors):.1g}")


def _short(reason: str) -> str:
    """Returns the first line of a reason, without its quotations from the module."""
    return re.sub(r" \([\w.]+\.py:\d+: .*\)", "", reason.splitlines()[0])


def _way(router: VoronoiRouter, method: str) -> dict[str, Any]:
    """Returns the evaluation path that `explain` reports for a method.

    If the method is only partly fused, also returns the functions that PyTorch computes between the fused parts.
    """
    line = next(line for line in router.explain().splitlines() if line.startswith(f"{method}: "))
    name, _, why = line.removeprefix(f"{method}: ").partition(": ")
    if name != "fused in runs":
        return {"how": f"{name}: {_short(why)}" if why else name}
    lines = re.findall(r"(?:between them |\); )([\w., ]+) \(", why)
    return {"how": name, "between": sorted({function for line in lines for function in line.split(", ")})}
