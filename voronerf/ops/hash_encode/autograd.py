"""The derivatives of ``hash_encode``, shared by the native and the Warp backend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.custom_op import Op
from voronerf.ops._core.derivatives import aliases, needed_gradients, second_derivatives
from voronerf.ops._core.grids import HashGrid
from voronerf.ops.hash_encode.reference import interpolate


class Hashed(NamedTuple):
    """The arguments of the encoding. With directions [n, 3], the result is the features' directional derivatives.

    Positions are float32, and ``grid`` is the text of a `HashGrid`.
    """

    positions: Tensor
    table: Tensor
    direction: Tensor | None
    cells: Tensor | None
    grid: str

    def result(self: Hashed) -> Tensor:
        """Allocates the features."""
        return self.positions.new_empty(self.positions.shape[0], HashGrid.parse(self.grid).out_features)


class HashedGradient(NamedTuple):
    """The arguments of the backward pass: the gradient of the features, and flags for the wanted gradients."""

    gradient: Tensor
    arguments: Hashed
    to_positions: bool
    to_table: bool

    def results(self: HashedGradient) -> list[Tensor]:
        """Allocates the gradients of positions and table, in float32; empty if they are not wanted."""
        positions, table = self.arguments.positions, self.arguments.table
        shapes = positions.shape if self.to_positions else 0, table.shape if self.to_table else 0
        return [positions.new_empty(shape) for shape in shapes]


_NONE = Hashed._make([None] * 5)


class HashDerivatives:
    """Registers the derivatives of the hash encoding, from a backend's two ops.

    ``encode`` takes the fields of `Hashed` and returns the features or, with a direction, their derivatives along it.
    ``backward`` takes the fields of `HashedGradient` and returns the gradients of positions and table.

    Without a direction, the derivative of ``backward`` needs only these two ops. Let g be the gradient of the features,
    and p and t the cotangents of the two results of ``backward``: p for the gradient of the positions, t for the
    gradient of the table. The vector-Jacobian product of ``backward`` is then the gradient, with respect to g,
    positions and table, of ``sum(g * encode(positions, t)) + sum(g * encode(positions, table, direction=p))``. With a
    direction, this product is computed by the reference formula.
    """

    def __init__(self, encode: Op, backward: Op) -> None:
        self._encode, self._backward = encode, backward
        encode.register_autograd(self.encode, setup_context=self.encode_setup)
        backward.register_autograd(self.backward, setup_context=self.backward_setup)

    def encode_setup(self, ctx: Any, inputs: Sequence[Any], output: Tensor) -> None:
        """Saves the arguments of ``encode``."""
        *tensors, ctx.grid = inputs
        ctx.save_for_backward(*tensors)

    def encode(self, ctx: Any, gradient: Tensor) -> Hashed:
        """Returns the gradients of ``encode`` with respect to positions, table and direction."""
        arguments = Hashed._make([*ctx.saved_tensors, ctx.grid])
        to_positions, to_table, to_direction, _ = needed_gradients(ctx, arguments[:4])
        gradients = _NONE
        if to_positions or to_table:
            of_positions, of_table = self._backward(gradient, arguments, to_positions, to_table)
            if to_positions:
                gradients = gradients._replace(positions=of_positions)
            if to_table:
                gradients = gradients._replace(table=of_table.to(arguments.table.dtype))
        if to_direction:
            gradients = gradients._replace(
                direction=self._backward(gradient, arguments._replace(direction=None), True, False)[0]
            )
        return gradients

    def backward_setup(self, ctx: Any, inputs: Sequence[Any], output: Sequence[Tensor]) -> None:
        """Saves the arguments of ``backward``."""
        gradient, (*tensors, ctx.grid), ctx.to_positions, ctx.to_table = inputs
        ctx.save_for_backward(gradient, *tensors)

    def backward(self, ctx: Any, cotangents: list[Tensor]) -> tuple[Any, ...]:
        """Returns the gradients of the inputs of ``backward``: the features' gradient, positions, table, direction."""
        saved = gradient, *tensors = ctx.saved_tensors
        arguments = Hashed._make([*tensors, ctx.grid])
        p, t = (part if want else None for part, want in zip(cotangents, (ctx.to_positions, ctx.to_table)))
        if arguments.direction is not None:
            of_gradient, *parts = self._by_the_reference(gradient, arguments, p, t)
            return of_gradient, Hashed._make([*parts, None, None]), None, None
        to_gradient, to_positions, to_table, _, _ = needed_gradients(ctx, saved)
        gradients: list[Tensor | None] = [None, None, None]

        def add(place: int, part: Tensor) -> None:
            before = gradients[place]
            gradients[place] = part if before is None else before + part

        for features, along in ((t, None), (None if p is None else arguments.table, p)):
            if features is None:
                continue
            term = arguments._replace(table=features, direction=along)
            if to_gradient:
                add(0, self._encode(*term))
            # The first term does not read the table, so only the second contributes to the table's gradient.
            of_table = to_table and along is not None
            if to_positions or of_table:
                parts = self._backward(gradient, term, to_positions, of_table)
                if to_positions:
                    add(1, parts[0])
                if of_table:
                    add(2, parts[1].to(arguments.table.dtype))
        return gradients[0], Hashed._make([*gradients[1:], None, None, None]), None, None

    def _by_the_reference(
        self, gradient: Tensor, arguments: Hashed, p: Tensor | None, t: Tensor | None
    ) -> list[Tensor | None]:
        """Returns the gradients for `backward` if there is a direction, by the reference formula."""
        leaves, graph = aliases([gradient, arguments.positions, arguments.table, arguments.direction])
        with torch.enable_grad():
            arriving, positions, table, direction = leaves
            assert positions is not None and table is not None and arriving is not None
            out = interpolate(positions, table, HashGrid.parse(arguments.grid), arguments.cells)
            (slopes,) = torch.autograd.grad(out, positions, arriving, create_graph=True)
            pairs = [(leaf, part) for leaf, part in ((positions, p), (table, t)) if part is not None]
            return second_derivatives([(slopes, direction)], pairs, leaves, graph)
