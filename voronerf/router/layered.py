"""Fields that describe themselves by a layer table, as one operation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from torch import Tensor, nn

from voronerf import ops
from voronerf.diagram.blending import Mixture
from voronerf.layers import MLP


@runtime_checkable
class LayeredField(Protocol):
    """A field that describes its network by a layer table, like :class:`voronerf.fields.NeRF`. It runs fused.

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
    first = {}
    for name in ("forward", "linears", "activate"):
        first[name] = next((i for i, base in enumerate(type(field).__mro__) if name in vars(base)), 0)
    if first["forward"] < max(first["linears"], first["activate"]) or "forward" in vars(field):
        return False
    return not any(
        part._forward_hooks
        or part._forward_pre_hooks
        or part._backward_hooks
        or part._backward_pre_hooks
        or "parametrizations" in part._modules
        for part in field.modules()
    )


def coords_by_rule(rule: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The positions that decide the cells, by a router's rule; None for those of the samples themselves."""
    if isinstance(rule, slice):
        return (args[0] if args else kwargs["positions"])[..., rule]
    return rule(*args, **kwargs) if callable(rule) else None


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments for a field's own ``forward``: a direction for each sample, in the place of one for each ray."""
    given = dict(zip(("positions", "directions", "ray_index"), args)) | kwargs
    directions, index = given.get("directions"), given.get("ray_index")
    if directions is None or index is None:
        return args, kwargs
    changed = {"directions": directions.index_select(0, index), "ray_index": None}
    placed = (*args[:1], *list(changed.values())[: max(len(args) - 1, 0)], *args[3:])
    return placed, {name: changed.get(name, value) for name, value in kwargs.items()}


def evaluate_table(
    field: LayeredField,
    where: Callable[[Tensor, Tensor | None], dict[str, Any]],
    backend: str,
    mixture_at: Callable[[Tensor], Mixture | None],
    positions: Tensor,
    directions: Tensor | None = None,
    ray_index: Tensor | None = None,
    *,
    coords: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """What a field with stacked parameters and a layer table gives: colour [n, 3] and density [n].

    Args:
        field: Whose ``activate`` gives the results; they are mixed behind it.
        where: What tells ``routed_mlp`` the cells, for positions and coords.
        backend: Of the operation.
        mixture_at: Other cells that some samples are evaluated in too, or None.
        positions: [n, 3] in scene units; [n, 6], means and variances, where the table integrates over Gaussians.
        directions: unit vectors, [n, 3], or [r, 3] together with ``ray_index``.
        ray_index: int32 [n], the row of ``directions`` that belongs to each sample.
        coords: [n, 3] or None, positions that decide the cells in the place of ``positions`` (of Gaussians, the means).

    Raises:
        ValueError: For shapes that disagree, or directions that the field needs and did not get.
        TypeError: For coords that are no floating-point tensor.
    """
    table, n = field.layers, positions.shape[0]
    features = 6 if table.integrated else 3
    if positions.ndim != 2 or positions.shape[1] != features:
        raise ValueError(f"VoronoiRouter: positions must have shape [n, {features}], got {list(positions.shape)}")
    if coords is not None:
        if not isinstance(coords, Tensor):
            raise TypeError(f"VoronoiRouter: coords must be a tensor, got {type(coords).__name__}")
        if coords.shape != (n, 3):
            raise ValueError(f"VoronoiRouter: coords must have shape [{n}, 3], got {list(coords.shape)}")
        if not coords.is_floating_point():
            raise TypeError(f"VoronoiRouter: coords must be floating-point, got {coords.dtype}")
    if not table.uses_directions:
        directions = ray_index = None
    if directions is not None and ray_index is None and directions.shape[0] != n:
        raise ValueError(
            "VoronoiRouter: directions must have a row for each position, or come with ray_index, got "
            f"{directions.shape[0]} rows for {n} positions"
        )
    linears = field.linears()
    weights, biases = [layer.weight for layer in linears], [layer.bias for layer in linears]

    def run(x: Tensor, d: Tensor | None, index: Tensor | None, cells: dict[str, Any]) -> tuple[Tensor, Tensor]:
        given = {"directions": d, "direction_index": index, "backend": backend, **cells}
        return field.activate(ops.routed_mlp(x, weights, biases, layers=table, **given)[0])

    own = run(positions, directions, ray_index, where(positions, coords))
    mixture = mixture_at(positions[:, :3] if coords is None else coords)
    if mixture is None:
        return own
    if ray_index is not None:
        ray_index = ray_index[mixture.rows]
    elif directions is not None:
        directions = directions[mixture.rows]
    others = run(positions[mixture.rows], directions, ray_index, {"cells": mixture.cells})
    return mixture.mix(own[0], others[0]), mixture.mix(own[1], others[1])
