"""Autograd of ``hash_encode``, shared by native and Warp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.custom_op import Op
from voronerf.ops._core.derivatives import aliases, asked_for, second_derivatives
from voronerf.ops._core.grids import HashGrid
from voronerf.ops.hash_encode.reference import interpolate


class Hashed(NamedTuple):
    """The arguments: positions in float32, the grid as its text; with directions [n, 3], derivatives along them."""

    positions: Tensor
    table: Tensor
    direction: Tensor | None
    cells: Tensor | None
    grid: str

    def result(self: Hashed) -> Tensor:
        """Memory for the features."""
        return self.positions.new_empty(self.positions.shape[0], HashGrid.parse(self.grid).out_features)


class HashedGradient(NamedTuple):
    """What has arrived at the features of points, and what is wanted of it."""

    gradient: Tensor
    given: Hashed
    to_positions: bool
    to_table: bool

    def results(self: HashedGradient) -> list[Tensor]:
        """Memory for the gradients to positions and table, in float32, empty where not wanted."""
        positions, table = self.given.positions, self.given.table
        shapes = positions.shape if self.to_positions else 0, table.shape if self.to_table else 0
        return [positions.new_empty(shape) for shape in shapes]


_NONE = Hashed._make([None] * 5)


class HashDerivatives:
    """Registers the derivatives of the hash encoding by a backend's two ops.

    ``encode`` of the members of `Hashed` gives features or, with directions, their derivatives along them. ``backward``
    of those of `HashedGradient` gives the gradients of that to positions and table. With g the gradient that arrives, p
    and t the cotangents of the two gradients, the sum whose gradients are wanted is ``g * encode(t as the table) +
    g * encode(along p)``: the same two ops again.
    """

    def __init__(self, encode: Op, backward: Op) -> None:
        self._encode, self._backward = encode, backward
        encode.register_autograd(self.encode, setup_context=self.encode_setup)
        backward.register_autograd(self.backward, setup_context=self.backward_setup)

    def encode_setup(self, ctx: Any, inputs: Sequence[Any], output: Tensor) -> None:
        """Keeps the arguments of ``encode``."""
        *tensors, ctx.grid = inputs
        ctx.save_for_backward(*tensors)

    def encode(self, ctx: Any, gradient: Tensor) -> Hashed:
        """Gradients to positions, table and direction."""
        given = Hashed._make([*ctx.saved_tensors, ctx.grid])
        to_positions, to_table, to_direction, _ = asked_for(ctx, given[:4])
        found = _NONE
        if to_positions or to_table:
            of_positions, of_table = self._backward(gradient, given, to_positions, to_table)
            if to_positions:
                found = found._replace(positions=of_positions)
            if to_table:
                found = found._replace(table=of_table.to(given.table.dtype))
        if to_direction:
            found = found._replace(direction=self._backward(gradient, given._replace(direction=None), True, False)[0])
        return found

    def backward_setup(self, ctx: Any, inputs: Sequence[Any], output: Sequence[Tensor]) -> None:
        """Keeps the arguments of ``backward``."""
        gradient, (*tensors, ctx.grid), ctx.to_positions, ctx.to_table = inputs
        ctx.save_for_backward(gradient, *tensors)

    def backward(self, ctx: Any, cotangents: list[Tensor]) -> tuple[Any, ...]:
        """Gradients to the gradient, positions, table and direction."""
        saved = gradient, *tensors = ctx.saved_tensors
        given = Hashed._make([*tensors, ctx.grid])
        p, t = (part if want else None for part, want in zip(cotangents, (ctx.to_positions, ctx.to_table)))
        if given.direction is not None:
            of_gradient, *parts = self._by_the_reference(gradient, given, p, t)
            return of_gradient, Hashed._make([*parts, None, None]), None, None
        to_gradient, to_positions, to_table, _, _ = asked_for(ctx, saved)
        found: list[Tensor | None] = [None, None, None]

        def add(place: int, part: Tensor) -> None:
            before = found[place]
            found[place] = part if before is None else before + part

        for features, along in ((t, None), (None if p is None else given.table, p)):
            if features is None:
                continue
            term = given._replace(table=features, direction=along)
            if to_gradient:
                add(0, self._encode(*term))
            # The sum is linear in the table, which the first of its terms does not read.
            of_table = to_table and along is not None
            if to_positions or of_table:
                parts = self._backward(gradient, term, to_positions, of_table)
                if to_positions:
                    add(1, parts[0])
                if of_table:
                    add(2, parts[1].to(given.table.dtype))
        return found[0], Hashed._make([*found[1:], None, None, None]), None, None

    def _by_the_reference(
        self, gradient: Tensor, given: Hashed, p: Tensor | None, t: Tensor | None
    ) -> list[Tensor | None]:
        """Where the gradients are those of a derivative along a direction, which is a gradient itself."""
        leaves, graph = aliases([gradient, given.positions, given.table, given.direction])
        with torch.enable_grad():
            arriving, positions, table, direction = leaves
            assert positions is not None and table is not None and arriving is not None
            out = interpolate(positions, table, HashGrid.parse(given.grid), given.cells)
            (slopes,) = torch.autograd.grad(out, positions, arriving, create_graph=True)
            pairs = [(leaf, part) for leaf, part in ((positions, p), (table, t)) if part is not None]
            return second_derivatives([(slopes, direction)], pairs, leaves, graph)
