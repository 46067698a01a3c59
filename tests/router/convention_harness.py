"""The reference for a routed field: a loop over the cells, with a mask and a separate module for each cell.

A `Case` is a field, its arguments as its codebase passes them, and the router's options. The case creates the modules
of the cells without a router, so the loop shares no code with the router. Letters: n samples, k cells.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import functools
import importlib.util
import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

from voronerf import VoronoiDiagram, VoronoiRouter

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
K = 5


def example(name: str) -> ModuleType:
    """Imports the script `name` from `examples/`."""
    full = f"examples_{name}"
    if full not in sys.modules:
        spec = importlib.util.spec_from_file_location(full, EXAMPLES / f"{name}.py")
        assert spec is not None and spec.loader is not None
        sys.modules[full] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[full])
    return sys.modules[full]


Arguments = tuple[tuple[Any, ...], dict[str, Any]]
RAYS = (9, 7)  # different from all numbers of features


def uniform(lead: tuple[int, ...], features: int = 3) -> Tensor:
    return torch.rand(*lead, features) * 2 - 1


def first(x: Tensor, *_: Any, **__: Any) -> Tensor:
    return x[..., :3]


def one(features: int = 7) -> Callable[[tuple[int, ...]], Arguments]:
    """Returns a function that makes a single tensor argument, whose first three features are the position."""
    return lambda lead: ((uniform(lead, features),), {})


of_seven = one()


@dataclasses.dataclass(frozen=True)
class Case:
    """A field, its arguments, and how a router runs it.

    Attributes:
        name: the name of the test.
        make: a function that returns a new field with random float32 parameters.
        arguments: a function from the leading shape to float32 (args, kwargs).
        positions: a function from the arguments to positions [..., 3].
        lead: leading shape of the samples: (n,), or (rays, samples).
        options: the options of the router.
        passes_coords: whether to pass the positions as ``coords`` at the call.
        method: the name of the called method.
        way: the expected evaluation path: "fused" or "grouped" (the module and each of its functions run once for
            all cells), or "cell by cell".
        fuses: whether the case is also tested with ``fuse=True``.
        rank: the number of dimensions of a sample's tensors in the loop; 3 means [m, 1, d].
        by_parameters: whether second derivatives with respect to parameters are compared; PyTorch's are wrong for
            ``torch._weight_norm``.
    """

    name: str
    make: Callable[[], nn.Module]
    arguments: Callable[[tuple[int, ...]], Arguments] = of_seven
    positions: Callable[..., Tensor] = first
    lead: tuple[int, ...] = (61,)
    options: dict[str, Any] = dataclasses.field(default_factory=lambda: {"coords": "first3"})
    passes_coords: bool = False
    method: str = "forward"
    way: str = "grouped"
    fuses: bool = False
    rank: int = 2
    by_parameters: bool = True

    def __str__(self) -> str:
        return self.name

    def fused(self) -> Case:
        options = {**self.options, "fuse": True}
        return dataclasses.replace(self, name=f"{self.name}, fused", options=options, way="fused")

    def modules(self, dtype: torch.dtype = torch.float32, k: int = K) -> list[nn.Module]:
        """Returns a module with random parameters for each of k cells; modules hold the same shared parameters."""
        modules = [randomised(self.make()).to(dtype) for _ in range(k)]
        for name, parameter in modules[0].named_parameters():
            if any(fnmatch.fnmatch(name, pattern) for pattern in self.options.get("share", ())):
                parent, _, leaf = name.rpartition(".")
                for module in modules:
                    setattr(module.get_submodule(parent), leaf, parameter)
        return modules

    def call(self, module: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Calls the field's method on a module or a router."""
        function = module if self.method == "forward" else getattr(module, self.method)
        if self.passes_coords and isinstance(module, VoronoiRouter):
            kwargs = {**kwargs, "coords": self.positions(*args, **kwargs)}
        return function(*args, **kwargs)


def randomised(module: nn.Module) -> nn.Module:
    """Adds noise to every trainable parameter, so that none keeps an initial value of zero or one."""
    with torch.no_grad():
        for parameter in module.parameters():
            if parameter.requires_grad:
                parameter += 0.1 * torch.randn_like(parameter)
    return module


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
        return dataclasses.replace(
            tree, **{f.name: mapped(getattr(tree, f.name), function) for f in dataclasses.fields(tree)}
        )
    return tree


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (path, value) for each leaf of an output; the path contains the types of the containers."""
    kind = type(tree).__name__
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, f"{path}/{kind}[{key}]")
    elif isinstance(tree, (tuple, list)):
        for index, value in enumerate(tree):
            yield from leaves(value, f"{path}/{kind}[{index}]")
    elif dataclasses.is_dataclass(tree) and not isinstance(tree, type):
        for f in dataclasses.fields(tree):
            yield from leaves(getattr(tree, f.name), f"{path}/{kind}.{f.name}")
    else:
        yield path, tree


def tensors(tree: Any) -> dict[str, Tensor]:
    """Returns the tensors of an output by path. Keys of other leaves contain the values, to compare them."""
    return {path if isinstance(v, Tensor) else f"{path}={v!r}": v for path, v in leaves(tree)}


def prepared(case: Case, dtype: torch.dtype, lead: tuple[int, ...] | None = None) -> tuple[Any, Any, list[Tensor]]:
    """Returns the arguments in a dtype; their floating-point tensors are leaves with gradients, also listed."""
    inputs: list[Tensor] = []

    def take(tensor: Tensor) -> Tensor:
        if not tensor.is_floating_point():
            return tensor
        inputs.append(tensor.detach().to(dtype).clone().requires_grad_())
        return inputs[-1]

    args, kwargs = mapped(case.arguments(case.lead if lead is None else lead), take)
    return args, kwargs, inputs


def nearest(case: Case, centres: Tensor, args: Any, kwargs: Any) -> Tensor:
    """Returns the cells of the samples, int64 [n]."""
    positions = case.positions(*args, **kwargs).detach().reshape(-1, 3).double()
    return (positions[:, None] - centres.double()).square().sum(-1).argmin(1)


def loop(case: Case, modules: list[nn.Module], cells: Tensor, args: Any, kwargs: Any) -> dict[str, Tensor]:
    """Evaluates the samples of each cell by the cell's module; returns the outputs by path. ``cells``: int64 [n]."""
    n, lead = cells.shape[0], case.lead

    def rows(index: Tensor) -> Callable[[Tensor], Tensor]:
        def take(tensor: Tensor) -> Tensor:
            if tensor.dim() >= len(lead) and tensor.shape[: len(lead)] == lead:
                flat = tensor.reshape(n, *tensor.shape[len(lead) :])
            elif len(lead) == 2 and tensor.shape[0] == lead[0]:  # a row for each ray
                return tensor.repeat_interleave(lead[1], 0)[index]
            else:
                return tensor
            return flat[index][:, None] if case.rank == 3 else flat[index]

        return take

    order, parts = [], []
    for cell in cells.unique().tolist():
        index = (cells == cell).nonzero()[:, 0]
        order.append(index)
        part = tensors(case.call(modules[cell], *mapped((args, kwargs), rows(index))))
        parts.append({key: v.squeeze(1) if case.rank == 3 and isinstance(v, Tensor) else v for key, v in part.items()})
    inverse = torch.cat(order).argsort()
    result = {}
    for key, first in parts[0].items():
        if isinstance(first, Tensor):
            joined = torch.cat([part[key] for part in parts])[inverse]
            result[key] = joined.reshape(*lead, *joined.shape[1:])
        else:
            result[key] = first
    return result


def routed(case: Case, modules: list[nn.Module], centres: Tensor | VoronoiDiagram, **options: Any) -> VoronoiRouter:
    """Returns a router whose cells are these modules."""
    return VoronoiRouter.from_modules(modules, centres, **{**case.options, **options})


def close(
    actual: dict[str, Any], expected: dict[str, Any], *, rtol: float | None = None, atol: float | None = None
) -> None:
    """Checks that structures, shapes and dtypes are equal, and that numbers are close."""
    assert list(actual) == list(expected)
    for key, value in expected.items():
        if isinstance(value, Tensor):
            torch.testing.assert_close(actual[key], value, rtol=rtol, atol=atol, msg=lambda m, key=key: f"{key}: {m}")


def scalar(outputs: dict[str, Any]) -> Tensor:
    """Returns a loss that weights every number of the outputs differently; the weights are equal in all calls."""
    generator = torch.Generator().manual_seed(7)
    parts = []
    for value in outputs.values():
        if isinstance(value, Tensor) and value.is_floating_point():
            weights = torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value.dtype)
            parts.append((value * weights).sum())
    return torch.stack(parts).sum()


def gradients(
    of: list[nn.Module] | VoronoiRouter, loss: Tensor, inputs: list[Tensor], **options: Any
) -> dict[str, Tensor]:
    """Returns the gradients to parameters [k, ...] by name, and to inputs; ``of`` is a router or a loop's modules."""
    modules = [of.module] if isinstance(of, VoronoiRouter) else of
    names = [name for name, p in modules[0].named_parameters() if p.requires_grad]
    own = [list(dict.fromkeys(m.get_parameter(name) for m in modules)) for name in names]  # one if it is shared
    wanted = [*itertools.chain(*own), *inputs]
    options = {"allow_unused": True, "materialize_grads": True, "retain_graph": True, **options}
    following = iter(torch.autograd.grad(loss, wanted, **options))
    result = {}
    for name, parameters in zip(names, own):
        parts = [next(following) for _ in parameters]
        result[name] = parts[0] if len(parts) == 1 else torch.stack(parts)
    return {**result, **{f"input {i}": gradient for i, gradient in enumerate(following)}}


class Counter:
    """Counts the calls of a method and the rows of the first tensor in each call, which holds the samples."""

    def __init__(self, monkeypatch: Any, cls: type[nn.Module], method: str) -> None:
        self.rows: list[int] = []
        owner = next(base for base in cls.__mro__ if method in vars(base))
        original = getattr(owner, method)

        @functools.wraps(original)
        def counted(module: nn.Module, *args: Any, **kwargs: Any) -> Any:
            inputs = [v for _, v in leaves((args, kwargs)) if isinstance(v, Tensor)]
            self.rows.append(inputs[0].shape[0])
            return original(module, *args, **kwargs)

        monkeypatch.setattr(owner, method, counted)
