"""The fused route of the compiled module as a PyTorch op: locate, sort, and the networks, in one call.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams. The rows of a tile are gathered from where
the samples lie and its results written to where they belong, so that nothing but the order (int32) has n rows beside
the op's own inputs and outputs. On CUDA these are launches one after another on the current stream, and nothing is
read on the host. The backward op is that of ``grouped_mlp``, given the order. Shapes and dtypes have been validated by
``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.layers import MLP
from voronerf.ops.cell_sort import native as cell_sort
from voronerf.ops.grouped_mlp import network as grouped_mlp
from voronerf.ops.grouped_mlp.gradients import gradients_of_network, keep_network, kept_network
from voronerf.ops.grouped_mlp.network import Given, Network, as_network
from voronerf.ops.locate_cell import native as locate_cell
from voronerf.ops.nearest_centre import native as nearest_centre
from voronerf.ops.routed_mlp.reference import Where, first_rows


def routed_mlp(
    positions: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor | None], **given: Any
) -> tuple[Tensor, Tensor]:
    """Output in the order of the positions, and the cells; see ``voronerf.ops.routed_mlp``."""
    call, dtype = prepared(positions, weights, biases, **given)
    out, found, *_ = forward(*call)
    if call.where.cells is not None:
        found = call.where.cells
    out = out.to(dtype)
    return (out, found) if call.where.rows is None or native.on_cuda(out) else first_rows(out, found, call.where.rows)


class Call(NamedTuple):
    """The arguments of ``forward``."""

    network: Network
    where: Where


def prepared(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
    **places: Any,
) -> tuple[Call, torch.dtype]:
    """The arguments of ``forward``, and the type of the result; ``places`` are those of `Where`."""
    where = Where(**places)
    centres, child_offsets, child, depth, cells, coords, rows = where
    own = features is not None and features.dim() == 3
    given = Given(positions, weights, biases, layers, directions, direction_index, features)
    before = grouped_mlp.hashes_before(given)
    if own and before and weights[0].shape[0] > 1 and cells is None:
        assert coords is not None and centres is not None
        if child_offsets is None or child is None:
            cells = nearest_centre.nearest_centre(coords, centres)
        else:
            cells = locate_cell.locate_cell(coords, centres, child_offsets, child, depth)
        centres = None
    if features is not None and own and weights[0].shape[0] == 1:
        given = given._replace(features=features[0])
    taken, dtype = as_network(given, cells, "routed_mlp", hashed_before=before)
    if rows is not None and cells is not None and native.on_cuda(cells):
        cells = torch.where(torch.arange(cells.shape[0], device=cells.device) < rows, cells, -1)
    if cells is None and weights[0].shape[0] == 1:
        where = Where(depth=depth, rows=rows)
    elif cells is not where.cells:
        where = where._replace(centres=None, cells=cells)
    return Call(taken, where), dtype


@custom_op("routed_mlp_native")
def forward(network: Network, where: Where) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """Output, cells (empty where they are given), order (empty where there is one cell), offsets, encoded positions.

    With neither cells nor centres there is one cell.
    """
    centres, child_offsets, child, depth, cells, coords, rows = where
    positions = network.positions
    n, k = positions.shape[0], network.weights[0].shape[0]
    alone = cells is None and centres is None
    out, encoded = grouped_mlp.new_results(network)
    found = positions.new_empty(n if cells is None else 0, dtype=torch.int32)
    order = positions.new_empty(0 if alone else n, dtype=torch.int32)
    offsets = positions.new_empty(k + 1, dtype=torch.int32)
    yield out, found, order, offsets, encoded
    if alone:
        if rows is None or not native.on_cuda(positions):
            found.zero_()
            offsets[0], offsets[1] = 0, n
        else:
            found.copy_(torch.where(torch.arange(n, device=found.device) < rows, 0, -1))
            offsets[:1].zero_()
            offsets[1:].copy_(rows)
    else:
        if coords is not None and centres is not None:
            if child_offsets is None or child is None:
                nearest_centre.find(found, coords, centres, rows)
            else:
                locate_cell.find(found, coords, centres, (child_offsets, child, depth), "routed_mlp", rows)
        cell_sort.sort(found if cells is None else cells, order, offsets, "routed_mlp")
    grouped_mlp.run(out, encoded, network, offsets, None if alone else order)


def _setup(ctx: Any, inputs: Call, output: tuple[Tensor, ...]) -> None:
    network, where = inputs
    _, found, order, offsets, encoded = output
    ctx.alone = where.cells is None and where.centres is None
    ctx.mark_non_differentiable(found, order, offsets, encoded)
    ctx.set_materialize_grads(False)
    keep_network(ctx, network, order, offsets, encoded)


def _backward(ctx: Any, gradient: Tensor | None, *_others: None) -> tuple[Any, ...]:
    network, (order, offsets, encoded) = kept_network(ctx)
    sorted_by = None if ctx.alone else order
    found = gradients_of_network(ctx, gradient, network, offsets, sorted_by, encoded)
    return found, Where(*cast(Any, (None,) * len(Where._fields)))


forward.register_autograd(_backward, setup_context=_setup)
