"""Fields that describe their network by a layer table, which runs as one operation.

n samples, k cells, r rays.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol, runtime_checkable

from torch import Tensor, nn

from voronerf.ops._core.layers import MLP


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
    parts = part._modules
    if part._forward_hooks or part._forward_pre_hooks or part._backward_hooks or part._backward_pre_hooks:
        return False
    return "parametrizations" not in parts and all(_is_plain(each) for each in parts.values() if each is not None)


def parameters_of_table(field: LayeredField, k: int) -> dict[str, Any]:
    """The layers of a field with its parameters for k cells, as ``routed_mlp`` takes them."""
    linears = field.linears()
    # A parameter that all cells share has no dimension of cells; the operation takes one for each.
    weights = [w if w.dim() == 3 else w.expand(k, -1, -1) for w in [layer.weight for layer in linears]]
    biases = [b if b is None or b.dim() == 2 else b.expand(k, -1) for b in [layer.bias for layer in linears]]
    features = None if field.layers.grid is None else field.features  # type: ignore[attr-defined]
    return {"layers": field.layers, "weights": weights, "biases": biases, "features": features}


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments for a field's own ``forward``: a direction for each sample, in the place of one for each ray."""
    names = ("positions", "directions", "ray_index")
    positions, directions, index = ((dict(zip(names, args)) | kwargs).get(name) for name in names)
    if directions is None or index is None:
        return args, kwargs
    others = {name: value for name, value in kwargs.items() if name not in names}
    return (positions, directions.index_select(0, index), None, *args[3:]), others
