"""Compares a module of other code in VoronoiRouter with a loop over masks of distinct modules.

A new module needs only a :class:`Row`; :func:`compare`, :func:`errors` and :func:`speed` do the rest. n samples, k
cells.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import functools
import itertools
import math
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from harness import Run, Stopwatch, measure
from torch import Tensor, nn

from voronerf import VoronoiRouter

Loss = Callable[[list[Tensor], list[Tensor], list[Tensor]], Tensor]  # of results, inputs and parameters
N, K, SEED = 300, 4, 1
LARGEST = 69
SIZES = range(1, LARGEST + 1)
"""The batch sizes at which values are compared: the number of samples, or of rays. Sizes of a module's tensors up to
``LARGEST`` are compared, too."""
WAYS: dict[str, dict[str, Any]] = {"fused": {"fuse": True}, "grouped": {"way": "grouped"}}
"""The options of the routers that are compared at all of :data:`SIZES`."""
TIMED: dict[str, dict[str, Any]] = {**WAYS, "cell by cell": {"way": "loop"}}
"""The options of the routers that are timed."""
TIMED_SIZES, TIME_LIMIT = (1024, 8192), 0.05
"""The numbers of samples of timed steps, and the seconds for each way at each number."""
ROUNDED = 1e-4
"""If the float32 error of a module exceeds this value, the module is compared in float64, too."""
NO_PART = 1e-6
"""A tensor's error is divided by its size (its largest entry or its norm), or by this fraction of the largest tensor's
size, whichever is larger: a smaller tensor is zero except for rounding."""


def mapped(tree: Any, function: Callable[[Tensor], Any]) -> Any:
    """Applies ``function`` to every tensor in tuples, lists, dicts and dataclasses, and returns the new tree."""
    if isinstance(tree, Tensor):
        return function(tree)
    if isinstance(tree, dict):
        return {key: mapped(value, function) for key, value in tree.items()}
    if isinstance(tree, (tuple, list)):
        parts = [mapped(value, function) for value in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)
    if dataclasses.is_dataclass(tree) and not isinstance(tree, type):
        names = [each.name for each in dataclasses.fields(tree)]
        return dataclasses.replace(tree, **{name: mapped(getattr(tree, name), function) for name in names})
    return tree


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (path, value) for each leaf of a tree; the path contains the types of the containers."""
    kind, items = type(tree).__name__, None
    if isinstance(tree, dict):
        items = tree.items()
    elif isinstance(tree, (tuple, list)):
        items = enumerate(tree)
    elif dataclasses.is_dataclass(tree) and not isinstance(tree, type):
        items = [(each.name, getattr(tree, each.name)) for each in dataclasses.fields(tree)]
    if items is None:
        yield path, tree
    else:
        for key, value in items:
            yield from leaves(value, f"{path}/{kind}[{key}]")


def uniform(lead: tuple[int, ...], *shape: int) -> Tensor:
    """Returns numbers between -1 and 1, [*lead, *shape]."""
    return torch.rand(*lead, *shape) * 2 - 1


def of(*shape: int) -> Callable[[tuple[int, ...]], Tensor]:
    """Returns a function that makes a tensor of a shape for each sample."""
    return lambda lead: uniform(lead, *shape)


def per_ray(*shape: int) -> Callable[[tuple[int, ...]], Tensor]:
    """Returns a function that makes a tensor of a shape for each ray."""
    return lambda lead: uniform(lead[:1], *shape)


def numbers(bound: int, *shape: int) -> Callable[[tuple[int, ...]], Tensor]:
    """Returns a function that makes whole numbers below a bound for each sample."""
    return lambda lead: torch.randint(0, bound, (*lead, *shape))


def inner(x: Tensor, *_: Any, **__: Any) -> Tensor:
    """Returns the first three features of each sample, for samples with axes of their own."""
    return x.flatten(1)[:, :3]


def evaluated(module: nn.Module) -> nn.Module:
    """Sets a module to evaluation mode, and the running statistics of its BatchNorms to random numbers."""
    for layer in module.modules():
        if isinstance(layer, nn.modules.batchnorm._BatchNorm):
            layer.running_mean.normal_()
            layer.running_var.uniform_(0.5, 2)
    return module.eval()


def shared_names(module: nn.Module, patterns: Sequence[str]) -> list[str]:
    """Returns the names of a module's parameters that match one of the patterns."""
    names = [name for name, _ in module.named_parameters()]
    return [name for name in names if any(fnmatch.fnmatch(name, pattern) for pattern in patterns)]


def share(module: nn.Module, first: nn.Module, names: Sequence[str]) -> nn.Module:
    """Replaces the named parameters of ``module`` by the parameters of ``first`` with the same names."""
    for name in names:
        path, _, last = name.rpartition(".")
        module.get_submodule(path).register_parameter(last, first.get_parameter(name))
    return module


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
        ways: The ways that tests of every run compare: "fused" with ``fuse=True``; "grouped" or "cell by cell", as the
            module runs without ``fuse``. Long tests compare the other rows, too.
    """

    module: str
    make: Callable[..., nn.Module]
    inputs: tuple[Any, ...] = (3,)
    method: str = "forward"
    keywords: Mapping[str, Any] = field(default_factory=dict)
    coords: Callable[..., Tensor] | None = None
    lead: tuple[int, ...] = (N,)
    options: Mapping[str, Any] = field(default_factory=dict)
    second: bool = False
    ways: tuple[str, ...] = ()

    def arguments(self, dtype: torch.dtype) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Returns arguments and keyword arguments, whose float tensors require gradients."""

        def build(item: Any) -> Any:
            value = uniform(self.lead, item) if type(item) is int else item(self.lead) if callable(item) else item
            return mapped(value, leaf)

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
            share(module, modules[0], self.shared(modules[0]))
        return modules

    def shared(self, module: nn.Module) -> list[str]:
        """Returns the names of the parameters that all cells have in common."""
        return shared_names(module, self.options.get("share", ()))

    def part(self, value: Tensor, rows: Tensor) -> Tensor:
        """Returns an argument's rows for some samples, as the router does; rows of rays are repeated per sample."""
        d = len(self.lead)
        if value.shape[:d] == self.lead:
            return value.flatten(0, d - 1)[rows].reshape(len(rows), *[1] * (d - 1), *value.shape[d:])
        return value[rows // self.lead[1]] if d > 1 and value.shape[:1] == self.lead[:1] else value


class Case:
    """The modules, arguments and cells of a row.

    The first samples are the centres of the cells, so that small batches have samples of several cells, too.

    Attributes:
        modules: The module of each cell.
        args, kwargs: The arguments of the samples.
        tensors: The tensors of the arguments.
        centres: The centres of the cells, [k, d].
    """

    def __init__(self, row: Row, imported: tuple[Any, ...] = (), dtype: torch.dtype = torch.float32) -> None:
        self.row, self.modules = row, row.modules(dtype, imported)
        self.args, self.kwargs = row.arguments(dtype)
        self.tensors = [value for _, value in leaves((self.args, self.kwargs)) if isinstance(value, Tensor)]
        self.coords: Any = row.coords or f"first{min(3, self.tensors[0].shape[-1])}"
        positions = row.coords(*self.args, **self.kwargs) if row.coords else self.tensors[0][..., :3]
        self.positions = positions.detach().flatten(0, len(row.lead) - 1)
        self.centres = self.positions[:: math.prod(row.lead[1:])][:K].clone()

    def cells(self) -> Tensor:
        """Returns the cell of each sample, [n]."""
        return (self.positions[:, None] - self.centres).square().sum(-1).argmin(1)

    def router(self, **options: Any) -> VoronoiRouter:
        """Returns a router of the modules."""
        methods = [self.row.method] * (self.row.method != "forward")
        options = {"coords": self.coords, "methods": methods, **options, **self.row.options}
        return VoronoiRouter.from_modules(self.modules, self.centres, **options)

    def routed(self, router: nn.Module, first: int | None = None) -> dict[str, Any]:
        """Returns the results of a router or a module, by path, for the first samples or rays; None for all."""
        method = router if self.row.method == "forward" else getattr(router, self.row.method)
        if first is None:
            return _results(method(*self.args, **self.kwargs))

        def short(value: Tensor) -> Tensor:
            part = value.detach()[:first] if value.shape[:1] == self.row.lead[:1] else value.detach()
            return part.requires_grad_(value.requires_grad and torch.is_grad_enabled())

        args, kwargs = mapped((self.args, self.kwargs), short)
        return _results(method(*args, **kwargs))

    def loop(self) -> dict[str, Any]:
        """Returns the results of the loop over masks, by path."""
        return _loop(self.row, self.modules, self.cells(), self.args, self.kwargs)

    @property
    def per_ray(self) -> list[int | str]:
        """The arguments with one row for each ray; shapes are ambiguous for as many rays as samples."""
        lead, named = self.row.lead, [*enumerate(self.args), *self.kwargs.items()]
        tensors = [(name, value) for name, value in named if isinstance(value, Tensor)]
        return [name for name, value in tensors if value.shape[:1] == lead[:1] and value.shape[: len(lead)] != lead]

    @functools.cached_property
    def looped(self) -> dict[str, Any]:
        """The results of the loop over masks, with gradients."""
        return self.loop()

    @functools.cached_property
    def differentiates(self) -> bool:
        """True if the module differentiates a result in its forward, and therefore needs gradients to be on."""
        with torch.no_grad():
            try:
                self.loop()
            except RuntimeError:
                return True
        return False


def compare(row: Row, *imported: Any) -> dict[str, Any]:
    """Returns how a module runs in the router and its largest errors, or why the router refuses it.

    The result also has the batch sizes at which values are wrong or which raise an error, by way, with the first
    message. For a module that is not fused, ``otherwise`` says how it runs without ``fuse``.
    """
    kind = type(row.make(*imported))
    found: dict[str, Any] = {"module": row.module, "class": f"{kind.__module__}.{kind.__qualname__}"}
    case = Case(row, imported)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row already reports an unfused module
        try:
            found |= errors(case, WAYS["fused"], imported)
        except Exception as error:
            found["how"] = f"refused: {_reason(error)}"
        try:
            _ = case.looped
        except Exception:  # the module mixes samples, and masks fail, too
            return found
        for name, options in WAYS.items():
            if name != "fused" or "value_error" in found:
                how = _add_sizes(found, name, options, case, imported)
                if name == "grouped" and not found["how"].startswith("fused"):
                    found["otherwise"] = how
    return found


def _add_sizes(found: dict[str, Any], name: str, options: Any, case: Case, imported: tuple[Any, ...]) -> str:
    """Adds the sizes with wrong values and with errors of a way to a result; returns how the router runs.

    A value is wrong only if it is wrong in float64, too.
    """
    how, wrong, raised = _sizes(case, options)
    if wrong and (exact := _in_double(_sizes, case, imported, options)):
        wrong = [size for size in wrong if size in exact[1] or size in exact[2]]
    if wrong:
        found.setdefault("wrong_sizes", {})[name] = _ranges(wrong)
    if raised:
        first = next(iter(raised.values()))
        found.setdefault("error_sizes", {})[name] = {"sizes": _ranges(list(raised)), "first": first}
    return how


def _ranges(sizes: list[int]) -> str:
    """Returns ascending numbers in short, such as "1-3, 7"."""
    runs = itertools.groupby(enumerate(sizes), key=lambda pair: pair[1] - pair[0])
    ends = [(run[0][1], run[-1][1]) for run in (list(group) for _, group in runs)]
    return ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in ends)


def _in_double(function: Callable[..., Any], case: Case, imported: tuple[Any, ...], *rest: Any) -> Any:
    """Returns what a function returns in float64, or None for modules that compute in float32 only."""
    torch.set_default_dtype(torch.float64)
    try:
        return function(Case(case.row, imported, torch.float64), *rest)
    except Exception:
        return None
    finally:
        torch.set_default_dtype(torch.float32)


def _sizes(case: Case, options: Mapping[str, Any]) -> tuple[str, list[int], dict[int, str]]:
    """Calls one router at all sizes, and new routers for which a size of a tensor of the module is the first size.

    Returns:
        How the router runs, the sizes with wrong values, and the messages of the sizes that raise an error.
    """
    wrong: set[int] = set()
    raised: dict[int, str] = {}
    options = {"per_ray": case.per_ray or None, **options}
    looped = [(value.detach(), float(value.abs().max()) or 1.0) for value in _tensors(case.looped)]
    tensors = [*case.modules[0].parameters(), *case.modules[0].buffers()]
    first = {size for tensor in tensors for size in tensor.shape if 0 < size <= LARGEST}
    sizes = sorted({*SIZES, *first})
    with torch.set_grad_enabled(case.differentiates):
        try:
            router = case.router(**options)
        except Exception as error:
            return f"refused: {_reason(error)}", [], {}
        for size, called in [*((size, router) for size in sizes), *((size, None) for size in sorted(first))]:
            try:
                routed = _tensors(case.routed(called or case.router(**options), size))
            except Exception as error:
                raised.setdefault(size, _reason(error))
                continue
            pairs = [(a.detach(), b[:size], largest) for a, (b, largest) in zip(routed, looped, strict=True)]
            if not all(a.shape == b.shape and float((a - b).abs().max()) <= ROUNDED * s for a, b, s in pairs):
                wrong.add(size)
        how = _way(router, case.row.method)["how"] if len(raised) < len(sizes) else "refused"
    return how, sorted(wrong), dict(sorted(raised.items()))


def errors(case: Case, options: Mapping[str, Any], imported: tuple[Any, ...] = (), **losses: Loss) -> dict[str, Any]:
    """Returns how a case runs with these options, and its largest errors; in float64, too, if those are large.

    ``losses`` are further losses whose gradients are compared.
    """
    way, found = _compared(case, options, losses)
    if not max(found.values()) <= ROUNDED and (exact := _in_double(_compared, case, imported, options, losses)):
        found |= {f"{name}_float64": error for name, error in exact[1].items()}
    return {**way, **found}


def _compared(
    case: Case, options: Mapping[str, Any], losses: Mapping[str, Loss]
) -> tuple[dict[str, Any], dict[str, float]]:
    row, modules, router = case.row, case.modules, case.router(**options)
    for _ in range(2):  # the second call may be cached
        routed = _tensors(case.routed(router))
    looped = _tensors(case.looped)
    if [value.shape for value in routed] != [value.shape for value in looped]:
        raise ValueError(f"shapes {[list(v.shape) for v in routed]} instead of {[list(v.shape) for v in looped]}")

    inputs = [value for value in case.tensors if value.requires_grad]
    names, shared = [n for n, p in modules[0].named_parameters() if p.requires_grad], row.shared(modules[0])
    stacked = [dict(router.module.named_parameters())[name] for name in names]
    tables = [dict(module.named_parameters()) for module in modules]
    single = [[table[name] for table in tables[: 1 if name in shared else K]] for name in names]
    losses = {"gradient_error": _weighted, **({"second_derivative_error": _eikonal} if row.second else {}), **losses}
    found = {"value_error": _error(routed, looped, lambda x: x.abs().max())}
    for name, loss in losses.items():
        got = _gradients(loss(routed, inputs, stacked), [*stacked, *inputs])
        separate = [p for cells in single for p in cells]
        right = iter(_gradients(loss(looped, inputs, separate), [*separate, *inputs]))
        parts = [[next(right) for _ in cells] for cells in single]
        expected = [torch.stack(part) if len(part) > 1 else part[0] for part in parts]
        found[name] = _error(got, [*expected, *right], torch.linalg.vector_norm)
    return _way(router, row.method), found


def speed(row: Row, *imported: Any) -> dict[str, dict[str, float]]:
    """Returns the milliseconds of a step by masks and the speeds of the ways relative to it, by the number of samples.

    A step is a forward and a backward pass to the parameters. A loop over masks finds the cells, too. The ways that
    the router refuses are left out.
    """
    rest = math.prod(row.lead[1:])
    return {str(n): _speed(Case(replace(row, lead=(n // rest, *row.lead[1:])), imported)) for n in TIMED_SIZES}


def _speed(case: Case) -> dict[str, float]:
    case.args, case.kwargs = mapped((case.args, case.kwargs), Tensor.detach)

    def step(forward: Callable[[], dict[str, Any]], *modules: nn.Module) -> Run:
        parameters = [parameter for module in modules for parameter in module.parameters()]

        def run(_: int) -> None:
            for parameter in parameters:
                parameter.grad = None
            losses = [value.square().mean() for value in _tensors(forward()) if value.requires_grad]
            torch.stack(losses).sum().backward()

        for _ in range(3):  # the first calls make a plan and a cached call
            run(0)
        return run

    contenders = {"masks": step(case.loop, *case.modules)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, options in TIMED.items():
            with contextlib.suppress(Exception):
                router = case.router(**options)
                contenders[name] = step(functools.partial(case.routed, router), router)
        stopwatch = Stopwatch(torch.device("cpu"), time.process_time)
        timings = measure(contenders, dict.fromkeys(contenders, TIME_LIMIT), stopwatch)
    masks = timings.pop("masks").median_ms
    return {"masks_ms": round(masks, 3), **{name: round(masks / t.median_ms, 2) for name, t in timings.items()}}


def _loop(row: Row, modules: list[nn.Module], cells: Tensor, args: Any, kwargs: Any) -> dict[str, Any]:
    """Runs the loop over masks: each module on the samples of its cell; returns the results by path."""
    order, parts = [], []
    for cell, module in enumerate(modules):
        rows = (cells == cell).nonzero()[:, 0]
        if len(rows):
            part = mapped((args, kwargs), lambda value, rows=rows: row.part(value, rows))
            order.append(rows)
            parts.append(_results(getattr(module, row.method)(*part[0], **part[1])))
    back, d = torch.cat(order).argsort(), len(row.lead)
    tensors = {key: [part[key] for part in parts] for key, value in parts[0].items() if isinstance(value, Tensor)}
    joined = {key: torch.cat(pieces)[back].reshape(*row.lead, *pieces[0].shape[d:]) for key, pieces in tensors.items()}
    return parts[0] | joined


def _results(results: Any) -> dict[str, Any]:
    """Returns the leaves of results by path; complex tensors as pairs of numbers."""
    return {
        path: torch.view_as_real(value) if isinstance(value, Tensor) and value.is_complex() else value
        for path, value in leaves(results)
    }


def _tensors(results: dict[str, Any]) -> list[Tensor]:
    return [value for value in results.values() if isinstance(value, Tensor)]


def _weighted(results: list[Tensor], *_: list[Tensor]) -> Tensor:
    """Returns a loss in which each number of the results has a different weight."""
    torch.manual_seed(SEED)
    terms = [(value * torch.randn(value.shape).to(value)).sum() for value in results]
    return torch.stack([term for term in terms if term.requires_grad]).sum()


def _eikonal(results: list[Tensor], inputs: list[Tensor], _: list[Tensor]) -> Tensor:
    (slope,) = torch.autograd.grad(results[0][..., 0].sum(), inputs[:1], create_graph=True)
    return (slope.norm(dim=-1) - 1).square().mean()


def curved(results: list[Tensor], inputs: list[Tensor], parameters: list[Tensor], by_parameters: bool = True) -> Tensor:
    """Returns the sum of the squares of the gradients of the weighted results."""
    options: dict[str, Any] = {"create_graph": True, "allow_unused": True, "materialize_grads": True}
    slopes = torch.autograd.grad(_weighted(results), [*inputs, *parameters * by_parameters], **options)
    return torch.stack([slope.square().sum() for slope in slopes]).sum()


def _gradients(loss: Tensor, of: list[Tensor]) -> list[Tensor]:
    return list(torch.autograd.grad(loss, of, retain_graph=True, allow_unused=True, materialize_grads=True))


def _error(got: list[Tensor], right: list[Tensor], size: Callable[[Tensor], Tensor]) -> float:
    """Returns the largest relative error of the tensors."""
    sizes = [float(size(value.detach())) for value in right]
    least = max(NO_PART * max(sizes), 1e-30)
    errors = [float(size((a - b).detach())) / max(s, least) for a, b, s in zip(got, right, sizes, strict=True)]
    return float(f"{max(errors):.1g}")


def _reason(error: Exception) -> str:
    return _short(str(error) or type(error).__name__)


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
