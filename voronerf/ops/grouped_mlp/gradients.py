"""The autograd of ops that run whole networks. n samples, r rays, k cells, p and q features of a raw position and
direction.

The kernels take a network's gradients in one pass, which has no derivative of its own. Gradients that will be
differentiated again are taken layer by layer, on the native ``grouped_linear``.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor

from voronerf.ops._core.derivatives import asked_for
from voronerf.ops._core.layers import DIRECTIONS, POSITIONS
from voronerf.ops.grouped_linear.activation import activate
from voronerf.ops.grouped_linear.cpu import layer as linear
from voronerf.ops.grouped_linear.reference import grouped_linear as _reference
from voronerf.ops.grouped_mlp.network import Network, Table, backward, encoded_already
from voronerf.ops.grouped_mlp.reference import cells_of
from voronerf.ops.grouped_mlp.reference import grouped_mlp as compose
from voronerf.ops.hash_encode.native import hash_encode
from voronerf.ops.spherical_harmonics.native import spherical_harmonics

# Rows that go through the layers together: their values stay in the cache.
_PIECE = 8192


def keep_network(ctx: Any, network: Network, *others: Tensor) -> None:
    """Saves a network and other tensors for the backward pass."""
    ctx.table, ctx.count = network.table, len(network.weights)
    positions, weights, biases, _, *rest, _ = network
    ctx.save_for_backward(positions, *weights, *biases, *rest, *others)


def kept_network(ctx: Any) -> tuple[Network, Sequence[Tensor]]:
    """What `keep_network` saved."""
    saved, count = ctx.saved_tensors, ctx.count
    weights, biases = saved[1 : 1 + count], saved[1 + count : 1 + 2 * count]
    directions, index, features, *others = saved[1 + 2 * count :]
    return Network(saved[0], weights, biases, ctx.table, directions, index, features, False), others


def gradients_of_network(
    ctx: Any, gradient: Tensor | None, network: Network, offsets: Tensor, order: Tensor | None, encoded: Tensor
) -> Network:
    """Gradients in the place of what they are of, None where there is none; ``ctx``: whom the engine asks for them."""
    count = ctx.count
    if gradient is None:
        return Network(*cast(Any, (None, [None] * count, [None] * count, *[None] * 5)))
    positions, weights, biases, _, directions, index, features, _ = network
    asked = asked_for(ctx, (positions, *weights, *biases, directions, index, features))
    to_positions, *to_parameters, to_directions, _, to_features = asked
    wanted = *to_parameters, to_positions, to_directions, to_features
    *found, of_positions, of_directions, of_features = _gradients(
        gradient, network, offsets, order, encoded, asked=wanted
    )
    return Network(
        *cast(Any, (of_positions, found[:count], found[count:], None, of_directions, None, of_features, None))
    )


def _gradients(
    gradient: Tensor, network: Network, offsets: Tensor, order: Tensor | None, encoded: Tensor, *, asked: Sequence[bool]
) -> list[Tensor | None]:
    """Gradients of weights, biases, positions, directions and features, None for those that are not asked for."""
    if torch.is_grad_enabled():
        return _layer_by_layer(gradient, network, offsets, order, asked=asked)
    *parameters, to_positions, to_directions, to_features = asked
    wanted = [any(parameters), to_positions, to_directions, to_features]
    *results, of_features = backward(gradient, network, offsets, order, encoded, wanted)
    if network.features is not None and to_features:
        of_features = of_features.to(network.features.dtype)
    return [result if want else None for result, want in zip((*results, of_features), asked)]


def _layer_by_layer(
    gradient: Tensor, network: Network, offsets: Tensor, order: Tensor | None, *, asked: Sequence[bool]
) -> list[Tensor | None]:
    """Gradients of weights, biases, positions, directions and features, None where they are not asked for.

    Args:
        gradient: [n, out], the incoming one.
        network: samples and parameters.
        offsets: int32 [k + 1].
        order: int32 [n] that sorts the rows by cell, or None where they are sorted.
        asked: which gradients, in the order of the results.
    """
    positions, weights, biases, text, directions, direction_index, features, _ = network
    layers = Table.parse(text).with_widths(weights)
    count = len(weights)
    present = [bias if bias.numel() else None for bias in biases]
    # Aliases: where one input was computed from another, that path is the caller's.
    leaves = [
        None if leaf is None else leaf.view_as(leaf) for leaf in (*weights, *present, positions, directions, features)
    ]
    *parameters, rows, seen, table = leaves
    assert rows is not None
    if seen is not None and layers.direction_degree is not None:
        seen = spherical_harmonics(seen, layers.direction_degree)
        layers = encoded_already(layers, DIRECTIONS)
    if seen is not None and direction_index is not None:
        seen = seen.index_select(0, direction_index.long())
    if order is not None:
        gradient, rows = (tensor.index_select(0, order.long()) for tensor in (gradient, rows))
        seen = None if seen is None else seen.index_select(0, order.long())
    if table is not None and layers.grid is not None:
        own = cells_of(offsets, rows) if table.dim() == 3 else None
        rows = hash_encode(rows, table, layers.grid, cells=own)
        layers = encoded_already(layers, POSITIONS)
    cells, lengths = _pieces(offsets, rows.shape[0])
    parts = [_split(parameter, cells) for parameter in parameters]
    outputs, first, start = [], 0, 0
    with torch.autocast(positions.device.type, enabled=False):
        for number, (piece, view) in enumerate(zip(rows.split(lengths), _split(seen, lengths), strict=True)):
            bounds = offsets[first : first + cells[number] + 1] - start
            given: list[Any] = [part[number] for part in parts]
            outputs.append(
                compose(piece, bounds, given[:count], given[count:], layers=layers, directions=view, linear=_layer)
            )
            first, start = first + cells[number], start + lengths[number]
    chosen = [want and leaf is not None for leaf, want in zip(leaves, asked)]
    sources = [leaf for leaf, want in zip(leaves, chosen) if leaf is not None and want]
    found = iter(torch.autograd.grad(torch.cat(outputs), sources, gradient, create_graph=True, allow_unused=True))
    return [next(found) if want else None for want in chosen]


def _pieces(offsets: Tensor, n: int) -> tuple[list[int], list[int]]:
    """Of pieces of whole cells, the numbers of cells and of rows; on the CPU of about ``_PIECE`` rows."""
    k = offsets.shape[0] - 1
    if offsets.is_cuda:
        return [k], [n]
    # Rows of no cell go with the first or the last piece.
    bounds, cells, first = [0, *offsets[1:-1].tolist(), n], [], 0
    for cell in range(1, k + 1):
        if bounds[cell] - bounds[first] >= _PIECE or cell == k:
            cells.append(cell - first)
            first = cell
    ends = list(itertools.accumulate(cells))
    return cells, [bounds[end] - bounds[end - size] for size, end in zip(cells, ends)]


def _split(tensor: Tensor | None, sizes: list[int]) -> Sequence[Tensor | None]:
    return [None] * len(sizes) if tensor is None else tensor.split(sizes)


def _layer(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, *, activation: str) -> Tensor:
    if x.is_cuda:
        return _reference(x, offsets, weight, bias, activation=activation)
    out: Tensor = linear(x, offsets, weight, bias, "none")
    return activate(activation, out)
