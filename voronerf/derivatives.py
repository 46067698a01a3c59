"""Autograd of the kernels' ops: what native and Warp share, and further derivatives through the reference formulas.

A kernel's op and its backward are custom ops of the same arguments in every backend; these functions are registered
with both. Letters as in the ops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.grids import HashGrid
from voronerf.reference.composite import composite
from voronerf.reference.frequency_encode import frequency_encode
from voronerf.reference.hash_encode import interpolate
from voronerf.reference.integrated_encode import integrated_encode
from voronerf.reference.render_loss import render_loss
from voronerf.reference.spherical_harmonics import spherical_harmonics


def asked_for(ctx: Any, inputs: Sequence[Tensor | None]) -> list[bool]:
    """For each tensor that an op took (None where an optional one is absent): will its gradient be used?

    ``ctx.needs_input_grad`` says which inputs require a gradient, not which the caller has asked for: in
    ``torch.autograd.grad(y, x, create_graph=True)`` the gradients of the weights would be computed and dropped, half of
    the products of an eikonal loss. torch's own layers ask the engine, and so does this.
    """
    edges = iter(ctx.next_functions)
    return [tensor is not None and _runs(next(edges)[0]) for tensor in inputs]


def _runs(node: Any) -> bool:
    # torch has no public name for this question; without the answer every gradient is computed.
    ask = getattr(torch._C, "_will_engine_execute_node", None)
    if node is None or ask is None:
        return node is not None
    # For leaves that torch.autograd.grad was asked for the engine refuses to answer, which takes 30 us: too long to ask
    # unless a whole graph is being made.
    if type(node).__name__ == "AccumulateGrad" and not torch.is_grad_enabled():
        return True
    try:
        return bool(ask(node))
    except RuntimeError:
        return True


def aliases(tensors: Sequence[Tensor | None]) -> tuple[list[Tensor | None], bool]:
    """Tensors to differentiate by within the derivative of a backward op, and whether that is differentiated again.

    Where it is, they stay parts of the caller's graph, as aliases: where one of them was computed from another, that
    path is the caller's. To be called before gradients are switched on.
    """
    graph = torch.is_grad_enabled()
    found = [
        None if t is None else t.view_as(t) if graph and t.requires_grad else t.detach().requires_grad_()
        for t in tensors
    ]
    return found, graph


def second_derivatives(
    outputs: Sequence[tuple[Tensor, Tensor | None]],
    firsts: Sequence[tuple[Tensor, Tensor]],
    tensors: Sequence[Tensor | None],
    graph: bool,
) -> list[Tensor | None]:
    """The derivative of gradients.

    Args:
        outputs: results of a formula, each with the gradient that arrives at it.
        firsts: tensors that the formula read, each with the cotangent of the gradient that it has got.
        tensors: the inputs to differentiate by, None for an absent one.
        graph: whether the results are differentiated again.

    Returns:
        For each of the tensors its derivative, None where there is none.
    """
    if not firsts:
        return [None] * len(tensors)
    parts, arriving = zip(*outputs, strict=True)
    sources, cotangents = zip(*firsts, strict=True)
    gradients = torch.autograd.grad(
        parts, sources, arriving, create_graph=True, allow_unused=True, materialize_grads=True
    )
    total = parts[0].new_zeros(())
    for gradient, cotangent in zip(gradients, cotangents, strict=True):
        total = total + (gradient * cotangent).sum()
    present = [tensor for tensor in tensors if tensor is not None]
    seconds = iter(torch.autograd.grad(total, present, create_graph=graph, allow_unused=True))
    return [None if tensor is None else next(seconds) for tensor in tensors]


def composite_forward_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    """Keeps sigma, rgb, depths, deltas, ray_offsets and background."""
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs)


def composite_forward_backward(backward: Callable[..., list[Tensor]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """Backward of composite by a backend's op, which takes the gradients of the four outputs (None for zero), the six
    inputs and which of the five gradients are wanted."""

    def run(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        needs = ctx.needs_input_grad
        if all(gradient is None for gradient in gradients):
            return (None,) * len(inputs)
        wanted = [*needs[:4], needs[5]]
        results = backward(*gradients, *inputs, wanted)
        found = [result if need else None for result, need in zip(results, wanted)]
        return (*found[:4], None, found[4])

    return run


def composite_backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    """Keeps the arguments of the backward op."""
    *tensors, ctx.wanted = inputs
    ctx.save_for_backward(*tensors)


def composite_backward_backward(ctx: Any, cotangents: list[Tensor | None]) -> tuple[Tensor | None, ...]:
    """Derivative of the gradients of composite."""
    saved = ctx.saved_tensors
    ray_offsets = saved[8]
    leaves, graph = aliases([None if i == 8 else tensor for i, tensor in enumerate(saved)])
    with torch.enable_grad():
        gradients, inputs = leaves[:4], [*leaves[4:8], leaves[9]]
        parts = composite(*inputs[:4], ray_offsets=ray_offsets, background=inputs[4])  # type: ignore[arg-type]
        outputs = [(part, gradient) for part, gradient in zip(parts, gradients) if gradient is not None]
        pairs = [
            (tensor, cotangent)
            for tensor, cotangent, want in zip(inputs, cotangents, ctx.wanted)
            if want and tensor is not None and cotangent is not None
        ]
        return (*second_derivatives(outputs, pairs, leaves, graph), None)


def render_loss_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    """Of the forward op of render_loss, the last of whose results is the gradient of the loss."""
    *tensors, ctx.density_scale, ctx.hidden = inputs
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*output[1:])
    ctx.save_for_backward(*tensors, output[-1])


def render_loss_backward(ctx: Any, of_loss: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, ...]:
    """Scales the gradient; where that is differentiated again, it comes from the reference formula."""
    *tensors, gradient = ctx.saved_tensors
    if of_loss is None:
        found = None
    elif torch.is_grad_enabled():
        raw, deltas, ray_offsets, target, background = tensors
        given = {"background": background, "density_scale": ctx.density_scale, "hidden": ctx.hidden}
        loss = render_loss(raw, deltas, ray_offsets, target, **given).loss
        (found,) = torch.autograd.grad(loss, raw, of_loss, create_graph=True)
    else:
        found = of_loss * gradient
    return found, None, None, None, None, None, None


def encode_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    """Keeps x, variances (None for the plain encoding), octaves and include_input."""
    x, variances, ctx.octaves, ctx.include_input = inputs
    ctx.save_for_backward(x, variances)


def encode_gradients(backward: Callable[..., list[Tensor]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """Backward of the encodings by a backend's op, which takes the gradient and what `encode_setup` keeps."""

    def run(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, variances = ctx.saved_tensors
        of_x, of_variances = backward(gradient, x, variances, ctx.octaves, ctx.include_input)
        return of_x, None if variances is None else of_variances, None, None

    return run


def encode_backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    """Keeps the arguments of the backward op."""
    gradient, x, variances, ctx.octaves, ctx.include_input = inputs
    ctx.save_for_backward(gradient, x, variances)


def encode_backward_backward(ctx: Any, cotangents: list[Tensor]) -> tuple[Tensor | None, ...]:
    """Derivative of the gradients of the encodings."""
    leaves, graph = aliases(ctx.saved_tensors)
    with torch.enable_grad():
        gradient, x, variances = leaves
        assert x is not None
        if variances is None:
            out = frequency_encode(x, ctx.octaves, include_input=ctx.include_input)
            inputs = [x]
        else:
            out = integrated_encode(x, variances, ctx.octaves)
            inputs = [x, variances]
        if not out.requires_grad:
            return (None,) * 5
        pairs = list(zip(inputs, cotangents))
        return (*second_derivatives([(out, gradient)], pairs, leaves, graph), None, None)


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


def harmonics_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    """Keeps directions and degree."""
    directions, ctx.degree = inputs
    ctx.save_for_backward(directions)


def harmonics_gradient(backward: Callable[..., Tensor]) -> Callable[..., tuple[Tensor, None]]:
    """Backward of spherical_harmonics by a backend's op, which takes the gradient, the directions and the degree."""

    def run(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (directions,) = ctx.saved_tensors
        return backward(gradient, directions, ctx.degree), None

    return run


def harmonics_backward_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    """Keeps the arguments of the backward op."""
    gradient, directions, ctx.degree = inputs
    ctx.save_for_backward(gradient, directions)


def harmonics_backward_backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
    """Derivative of the gradient of spherical_harmonics."""
    leaves, graph = aliases(ctx.saved_tensors)
    with torch.enable_grad():
        gradient, directions = leaves
        assert directions is not None
        out = spherical_harmonics(directions, ctx.degree)
        return (*second_derivatives([(out, gradient)], [(directions, cotangent)], leaves, graph), None)
