"""Fields that describe their network by a layer table, which runs as one operation.

n samples, k cells, r rays.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from voronerf.ops._core.layers import MLP
from voronerf.ops.routed_mlp import routed_mlp
from voronerf.router.layout import AS_TENSOR, as_plain


@runtime_checkable
class LayeredField(Protocol):
    """A field that describes its network by a layer table, like :class:`voronerf.nerf.fields.NeRF`. It runs fused.

    Where the table has a hash grid, the field has a parameter ``features``, [e, f], as :class:`voronerf.HashGridField`.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.router import LayeredField
        >>> isinstance(NeRF(width=16, depth=2), LayeredField)
        True
    """

    layers: MLP

    def linears(self) -> list[nn.Linear]:
        """The linear layers in the table's order."""
        ...

    def activate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Turns the table's outputs [n, out] into what the field returns."""
        ...


def described_by_table(field: nn.Module) -> bool:
    """Whether the table, the weights and ``activate`` of a field describe all that it computes.

    They do not if a class has its own ``forward`` without its own ``linears`` and ``activate``, or if hooks or
    parametrisations, such as weight normalisation, change inputs, outputs or weights of layers.
    """
    kind: Any = type(field)
    return "forward" not in vars(field) and _class_described_by_table(kind) and _is_plain(field)


@functools.cache
def _class_described_by_table(kind: type[nn.Module]) -> bool:
    first = {}
    for name in ("forward", "linears", "activate"):
        first[name] = next((i for i, base in enumerate(kind.__mro__) if name in vars(base)), 0)
    return first["forward"] >= max(first["linears"], first["activate"])


def _is_plain(part: nn.Module) -> bool:
    """Whether nothing is hooked into a module and its parts; the iterators of ``nn.Module`` take ten times as long."""
    parts: list[nn.Module | None] = [part]
    for each in parts:
        if each is None:
            continue
        if each._forward_hooks or each._forward_pre_hooks or each._backward_hooks or each._backward_pre_hooks:
            return False
        if (children := each._modules) and "parametrizations" in children:
            return False
        parts += children.values()
    return True


def parameters_of_table(field: LayeredField, k: int) -> dict[str, Any]:
    """The layers of a field with its parameters for k cells, as ``routed_mlp`` takes them."""
    linears = field.linears()
    # A parameter that all cells share has no dimension of cells; the operation takes one for each.
    weights = [w if w.dim() == 3 else w.expand(k, -1, -1) for w in [layer.weight for layer in linears]]
    biases = [b if b is None or b.dim() == 2 else b.expand(k, -1) for b in [layer.bias for layer in linears]]
    features = None if field.layers.grid is None else field.features  # type: ignore[attr-defined]
    return {"layers": field.layers, "weights": weights, "biases": biases, "features": features}


class Table:
    """The calls of a field whose program is given: all that its layer table describes."""

    name = "fused"

    def __init__(self, field: nn.Module) -> None:
        self._holds = described_by_table(field)

    def holds(self, field: nn.Module) -> bool:
        """Whether it describes all that a field computes."""
        if not torch.compiler.is_compiling():  # while it compiles, what was found before holds
            self._holds = described_by_table(field)
        return self._holds

    def run(self, router: Any, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | None) -> Any:
        """The results of a call; coords [..., d] are those that it was given."""
        arguments = _arguments(*args, **kwargs)
        if type(arguments["positions"]) is not Tensor:
            arguments = {name: as_plain(value) for name, value in arguments.items()}
        field, positions = router.module, arguments.pop("positions")
        features = 6 if field.layers.integrated else 3
        if not isinstance(positions, Tensor):
            raise TypeError(f"VoronoiRouter: positions must be a tensor, got {type(positions).__name__}; {AS_TENSOR}")
        if positions.ndim != 2 or positions.shape[1] != features:
            raise ValueError(f"VoronoiRouter: positions must have shape [n, {features}], got {list(positions.shape)}")
        arguments = arguments if field.layers.uses_directions else {}
        arguments |= parameters_of_table(field, router.num_cells)
        arguments |= router.places(positions, router._positions(args, kwargs, coords))
        return field.activate(routed_mlp(positions, **arguments, backend=router.backend)[0])


def _arguments(positions: Tensor, directions: Tensor | None = None, ray_index: Tensor | None = None) -> dict[str, Any]:
    """Those of a field's ``forward`` as `routed_mlp` takes them."""
    return {"positions": positions, "directions": directions, "direction_index": ray_index}


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
    """The arguments for a field's own ``forward``, with a direction for each sample in the place of one for each ray;
    None where they are as they should be."""
    names = ("positions", "directions", "ray_index")
    positions, directions, index = ((dict(zip(names, args)) | kwargs).get(name) for name in names)
    if directions is None or index is None:
        return None
    others = {name: value for name, value in kwargs.items() if name not in names}
    return (positions, directions.index_select(0, index), None, *args[3:]), others
