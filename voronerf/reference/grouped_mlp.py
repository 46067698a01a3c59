"""The whole per-cell network, piece by piece. n samples, r rays, k cells, p and q raw features of position and
direction.

``voronerf.reference.specification`` says in a few lines what this computes. Run layer by layer over the whole batch, a
network spends much of its time on memory: every activation, mask and gradient is a fresh array of n rows. Here a piece
of a cell goes through all layers, forward or backward, before the next piece is begun, and only what the backward needs
is kept (``hidden``). Two operators, opaque to ``torch.compile``: ``voronerf::grouped_mlp`` and
``voronerf::grouped_mlp_backward``. Derivatives of the backward itself go through the specification on
``voronerf::grouped_linear``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.layers import MLP
from voronerf.reference import specification
from voronerf.reference.grouped_linear import autocast, grouped_linear
from voronerf.reference.piecewise import Network, backward, compute_dtype, forward, kept_widths, split_parameters


def grouped_mlp(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
) -> Tensor:
    """Every sample through the network of its cell; see ``voronerf.ops.grouped_mlp``."""
    weights = [autocast(weight) for weight in weights]
    biases = [bias if bias is None else autocast(bias) for bias in biases]
    if not layers.uses_directions:
        directions, direction_index = None, None
    has_bias = [bias is not None for bias in biases]
    parameters = [*weights, *(bias for bias in biases if bias is not None)]
    inputs = [positions, *parameters] if directions is None else [positions, directions, *parameters]
    keep = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
    out, _ = torch.ops.voronerf.grouped_mlp(
        positions, directions, direction_index, offsets, parameters, has_bias, layers.text, keep
    )
    return out


def check_direction_index(op: str, directions: Tensor | None, direction_index: Tensor | None) -> None:
    """Raises ValueError for an index that names no ray; on the CPU, as it reads the index."""
    if directions is None or direction_index is None or direction_index.numel() == 0:
        return
    if direction_index.device.type != "cpu" or torch.compiler.is_compiling():
        return
    low, high = (int(bound) for bound in direction_index.aminmax())
    if low < 0 or high >= directions.shape[0]:
        last = directions.shape[0] - 1
        raise ValueError(f"{op}: direction_index must be 0 to {last}, got {low if low < 0 else high}")


@torch.library.custom_op("voronerf::grouped_mlp", mutates_args=())
def _mlp(
    positions: Tensor,
    directions: Tensor | None,
    direction_index: Tensor | None,
    offsets: Tensor,
    parameters: Sequence[Tensor],
    has_bias: Sequence[bool],
    layers: str,
    keep: bool,
) -> tuple[Tensor, list[Tensor]]:
    check_direction_index("grouped_mlp", directions, direction_index)
    network = Network(MLP.parse(layers), positions, directions, direction_index, offsets, parameters, has_bias)
    return forward(network, keep)


@_mlp.register_fake
def _(
    positions: Tensor,
    directions: Tensor | None,
    direction_index: Tensor | None,
    offsets: Tensor,
    parameters: Sequence[Tensor],
    has_bias: Sequence[bool],
    layers: str,
    keep: bool,
) -> tuple[Tensor, list[Tensor]]:
    table, n = MLP.parse(layers), positions.shape[0]
    out = parameters[0].new_empty(n, table.out_features)
    widths = kept_widths(table, positions.shape[1]) if keep else []
    dtype = compute_dtype(parameters[0])
    return out, [positions.new_empty(n, width, dtype=dtype) for width in widths]


@torch.library.custom_op("voronerf::grouped_mlp_backward", mutates_args=())
def _mlp_backward(
    g: Tensor,
    positions: Tensor,
    directions: Tensor | None,
    direction_index: Tensor | None,
    offsets: Tensor,
    parameters: Sequence[Tensor],
    has_bias: Sequence[bool],
    layers: str,
    hidden: Sequence[Tensor],
    needs: Sequence[bool],
) -> list[Tensor]:
    network = Network(MLP.parse(layers), positions, directions, direction_index, offsets, parameters, has_bias)
    return backward(network, g, hidden, list(needs))


@_mlp_backward.register_fake
def _(
    g: Tensor,
    positions: Tensor,
    directions: Tensor | None,
    direction_index: Tensor | None,
    offsets: Tensor,
    parameters: Sequence[Tensor],
    has_bias: Sequence[bool],
    layers: str,
    hidden: Sequence[Tensor],
    needs: Sequence[bool],
) -> list[Tensor]:
    inputs = [positions, directions, *parameters]
    return [tensor.new_empty(tensor.shape) for tensor, need in zip(inputs, needs) if need and tensor is not None]


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, list[Tensor]]) -> None:
    positions, directions, direction_index, offsets, parameters, has_bias, layers, _keep = inputs
    _, hidden = output
    ctx.has_bias, ctx.layers, ctx.kept = has_bias, layers, len(hidden)
    ctx.mark_non_differentiable(*hidden)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(positions, directions, direction_index, offsets, *hidden, *parameters)


def _backward(ctx: Any, g: Tensor | None, _: None) -> tuple[Any, ...]:
    positions, directions, direction_index, offsets, *rest = ctx.saved_tensors
    hidden, parameters = rest[: ctx.kept], rest[ctx.kept :]
    needs = [ctx.needs_input_grad[0], ctx.needs_input_grad[1], *ctx.needs_input_grad[4]]
    if g is None:
        return (None, None, None, None, [None] * len(parameters), None, None, None)
    if torch.is_grad_enabled():
        found = _differentiable(ctx, g, needs)
    else:
        network = (positions, directions, direction_index, offsets, parameters, ctx.has_bias, ctx.layers)
        if not hidden:
            _, hidden = torch.ops.voronerf.grouped_mlp(*network, True)
        found = torch.ops.voronerf.grouped_mlp_backward(g, *network, hidden, needs)
    gradients = iter(found)
    first, second, *rest = [next(gradients) if need else None for need in needs]
    return (first, second, None, None, rest, None, None, None)


def _differentiable(ctx: Any, g: Tensor, needs: list[bool]) -> Sequence[Tensor]:
    """The gradients as functions that can be differentiated again."""
    positions, directions, direction_index, offsets, *rest = ctx.saved_tensors
    # Aliases: where one input was computed from another, that path is the caller's, not this function's.
    positions, *parameters = (tensor.view_as(tensor) for tensor in (positions, *rest[ctx.kept :]))
    directions = None if directions is None else directions.view_as(directions)
    weights, biases = split_parameters(parameters, ctx.has_bias)
    out = specification.grouped_mlp(
        positions,
        offsets,
        weights,
        biases,
        layers=MLP.parse(ctx.layers),
        directions=directions,
        direction_index=direction_index,
        linear=grouped_linear,
    )
    wanted = [tensor for tensor, need in zip([positions, directions, *parameters], needs) if need]
    return torch.autograd.grad(out, wanted, g, create_graph=True, materialize_grads=True)


_mlp.register_autograd(_backward, setup_context=_setup)
