"""Fields that describe themselves by a layer table, as one operation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast, runtime_checkable

from torch import Tensor, nn

from voronerf import ops
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


def coords_by_rule(rule: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Tensor | None:
    """The coords of a call of such a field, by the rule that its router was given.

    Args:
        rule: None or "first3", a slice of the features of the positions, or a function of the arguments.
        args: of the call, the positions first.
        kwargs: of the call.

    Returns:
        Positions that decide the cells; None for those of the samples themselves.

    Raises:
        TypeError: for a function that returns no tensor.
    """
    if rule is None or rule == "first3":
        return None
    if isinstance(rule, slice):
        positions = args[0] if args else kwargs.get("positions")
        return None if positions is None else cast(Tensor, positions[..., rule])
    found = rule(*args, **kwargs)
    if not isinstance(found, Tensor):
        raise TypeError(f"VoronoiRouter: what coords returns must be a tensor, got {type(found).__name__}")
    return found


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments for a field's own ``forward``: a direction for each sample, in the place of one for each ray."""
    given = dict(zip(("positions", "directions", "ray_index"), args)) | kwargs
    directions, index = given.get("directions"), given.get("ray_index")
    if directions is None or index is None:
        return args, kwargs
    changed = {"directions": directions.index_select(0, index), "ray_index": None}
    placed = (*args[:1], *list(changed.values())[: max(len(args) - 1, 0)], *args[3:])
    return placed, {name: changed.get(name, value) for name, value in kwargs.items()}


class Mix(Protocol):
    """Further entries to evaluate, see :class:`voronerf.router.blended.Mixture`."""

    rows: Tensor
    cells: Tensor

    def mix(self, own: Tensor, others: Tensor) -> Tensor:
        """The results of the samples' own cells and of the entries, joined."""
        ...


def evaluate_blended(
    field: LayeredField,
    where: Callable[[Tensor, Tensor | None], dict[str, Any]],
    backend: str,
    mixture_at: Callable[[Tensor], Mix | None],
    positions: Tensor,
    directions: Tensor | None = None,
    ray_index: Tensor | None = None,
    *,
    coords: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """:func:`evaluate_table`, and again in other cells the samples for which ``mixture_at`` says so.

    Colours and densities are mixed as ``activate`` gives them.
    """
    own = evaluate_table(field, where, backend, positions, directions, ray_index, coords=coords)
    mixture = mixture_at(positions[:, :3] if coords is None else coords)
    if mixture is None:
        return own
    if ray_index is not None:
        ray_index = ray_index[mixture.rows]
    elif directions is not None:
        directions = directions[mixture.rows]
    cells = {"cells": mixture.cells}
    others = evaluate_table(field, lambda *_: cells, backend, positions[mixture.rows], directions, ray_index)
    return mixture.mix(own[0], others[0]), mixture.mix(own[1], others[1])


def evaluate_table(
    field: LayeredField,
    where: Callable[[Tensor, Tensor | None], dict[str, Any]],
    backend: str,
    positions: Tensor,
    directions: Tensor | None = None,
    ray_index: Tensor | None = None,
    *,
    coords: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Evaluates a field with a layer table for all cells, its parameters being stacked.

    Args:
        field: the field.
        where: gives for positions and coords what tells ``routed_mlp`` the cells.
        backend: of the operation.
        positions: [n, 3] in scene units; [n, 6], means and variances, where the table integrates over Gaussians.
        directions: unit vectors, [n, 3], or [r, 3] together with ``ray_index``.
        ray_index: int32 [n], the row of ``directions`` that belongs to each sample.
        coords: [n, 3] or None, positions that decide the cells in the place of ``positions`` (of Gaussians, the means).

    Returns:
        What the field's ``activate`` gives: (colour [n, 3], density [n]).

    Raises:
        ValueError: for shapes that disagree, or directions that the field needs and did not get.
        TypeError: for coords that are not floating-point.
    """
    table = field.layers
    features = 6 if table.integrated else 3
    if positions.ndim != 2 or positions.shape[1] != features:
        raise ValueError(f"VoronoiRouter: positions must have shape [n, {features}], got {list(positions.shape)}")
    if coords is not None and coords.shape != (positions.shape[0], 3):
        raise ValueError(f"VoronoiRouter: coords must have shape [{positions.shape[0]}, 3], got {list(coords.shape)}")
    if coords is not None and not coords.is_floating_point():
        raise TypeError(f"VoronoiRouter: coords must be floating-point, got {coords.dtype}")
    needs_directions = table.uses_directions
    if needs_directions and directions is None:
        raise ValueError("VoronoiRouter: directions must be given, since the field's colour depends on them")
    if not needs_directions:
        directions = ray_index = None
    if directions is not None and ray_index is None and directions.shape[0] != positions.shape[0]:
        raise ValueError(
            "VoronoiRouter: directions must have a row for each position, or come with ray_index, got "
            f"{directions.shape[0]} rows for {positions.shape[0]} positions"
        )

    linears = field.linears()
    raw, _ = ops.routed_mlp(
        positions,
        [layer.weight for layer in linears],
        [layer.bias for layer in linears],
        layers=table,
        directions=directions,
        direction_index=ray_index,
        backend=backend,
        **where(positions, coords),
    )
    return field.activate(raw)
