"""Autograd of ``hash_encode``, shared by native and Warp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf.derivatives import aliases, asked_for, second_derivatives
from voronerf.grids import HashGrid
from voronerf.ops.hash_encode.reference import interpolate


class HashDerivatives:
    """Derivatives of the hash encoding by a backend's two ops.

    ``encode(positions, table, direction, cells, grid)`` gives features or, with directions, their derivatives along
    them. ``backward(gradient, positions, table, direction, cells, grid, to_positions, to_table)`` gives the gradients
    of that to positions and table. With g the gradient that arrives, p and t the cotangents of the two gradients, the
    sum whose gradients are wanted is ``g * encode(t as the table) + g * encode(along p)``: the same two ops again.
    """

    def __init__(self, encode: Callable[..., Tensor], backward: Callable[..., list[Tensor]]) -> None:
        self._encode, self._backward = encode, backward

    def encode_setup(self, ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Keeps the arguments of ``encode``."""
        *tensors, ctx.grid = inputs
        ctx.save_for_backward(*tensors)

    def encode(self, ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients to positions, table and direction."""
        positions, table, direction, cells = ctx.saved_tensors
        to_positions, to_table, to_direction, _ = asked_for(ctx, ctx.saved_tensors)
        of_positions = of_table = of_direction = None
        if to_positions or to_table:
            of_positions, of_table = self._backward(
                gradient, positions, table, direction, cells, ctx.grid, to_positions, to_table
            )
        if to_direction:
            of_direction = self._backward(gradient, positions, table, None, cells, ctx.grid, True, False)[0]
        return (
            of_positions if to_positions else None,
            of_table.to(table.dtype) if of_table is not None and to_table else None,
            of_direction,
            None,
            None,
        )

    def backward_setup(self, ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
        """Keeps the arguments of ``backward``."""
        *tensors, ctx.grid, ctx.to_positions, ctx.to_table = inputs
        ctx.save_for_backward(*tensors)

    def backward(self, ctx: Any, cotangents: list[Tensor]) -> tuple[Tensor | None, ...]:
        """Gradients to the gradient, positions, table and direction."""
        gradient, positions, table, direction, cells = ctx.saved_tensors
        p, t = (part if want else None for part, want in zip(cotangents, (ctx.to_positions, ctx.to_table)))
        if direction is not None:
            return (*self._by_the_reference(ctx, p, t), None, None, None, None)
        to_gradient, to_positions, to_table, _, _ = asked_for(ctx, ctx.saved_tensors)
        found: list[Tensor | None] = [None, None, None]

        def add(place: int, part: Tensor) -> None:
            before = found[place]
            found[place] = part if before is None else before + part

        for features, along in ((t, None), (None if p is None else table, p)):
            if features is None:
                continue
            if to_gradient:
                add(0, self._encode(positions, features, along, cells, ctx.grid))
            # The sum is linear in the table, which the first of its terms does not read.
            of_table = to_table and along is not None
            if to_positions or of_table:
                parts = self._backward(gradient, positions, features, along, cells, ctx.grid, to_positions, of_table)
                if to_positions:
                    add(1, parts[0])
                if of_table:
                    add(2, parts[1].to(table.dtype))
        return (*found, None, None, None, None, None)

    def _by_the_reference(self, ctx: Any, p: Tensor | None, t: Tensor | None) -> list[Tensor | None]:
        """Where the gradients are those of a derivative along a direction, which is a gradient itself."""
        *tensors, cells = ctx.saved_tensors
        leaves, graph = aliases(tensors)
        with torch.enable_grad():
            gradient, positions, table, direction = leaves
            assert positions is not None and table is not None and gradient is not None
            out = interpolate(positions, table, HashGrid.parse(ctx.grid), cells)
            (slopes,) = torch.autograd.grad(out, positions, gradient, create_graph=True)
            pairs = [(leaf, part) for leaf, part in ((positions, p), (table, t)) if part is not None]
            return second_derivatives([(slopes, direction)], pairs, leaves, graph)
