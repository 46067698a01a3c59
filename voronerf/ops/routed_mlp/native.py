"""The fused route of the compiled module as a PyTorch op: locate, sort, and the networks, in one call.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams. The rows of a tile are gathered from where
the samples lie and its results written to where they belong, so that nothing but the order (int32) has n rows beside
the op's own inputs and outputs. On CUDA these are launches one after another on the current stream, and nothing is
read on the host. The backward op is that of ``grouped_mlp``, given the order. Shapes and dtypes have been validated by
``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.derivatives import asked_for
from voronerf.layers import MLP
from voronerf.native.custom_op import custom_op
from voronerf.ops.cell_sort import native as cell_sort
from voronerf.ops.grouped_mlp import native as grouped_mlp
from voronerf.ops.grouped_mlp.layer_table import network
from voronerf.ops.locate_cell import native as locate_cell
from voronerf.ops.nearest_centre import native as nearest_centre


def routed_mlp(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    centres: Tensor | None = None,
    child_offsets: Tensor | None = None,
    child: Tensor | None = None,
    depth: int = 1,
    centre_weights: Tensor | None = None,
    cells: Tensor | None = None,
    coords: Tensor | None = None,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Output in the order of the positions, and the cells; see ``voronerf.ops.routed_mlp``."""
    where = Where(centres, child_offsets, child, depth, centre_weights, cells, coords)
    arguments, dtype = prepared(positions, weights, biases, layers, where, directions, direction_index, features)
    out, found, *_ = forward(*arguments)
    given = arguments[7]
    return out.to(dtype), found if given is None else given


class Where(NamedTuple):
    """What tells the cells, as ``voronerf.ops.routed_mlp`` takes it."""

    centres: Tensor | None = None
    child_offsets: Tensor | None = None
    child: Tensor | None = None
    depth: int = 1
    centre_weights: Tensor | None = None
    cells: Tensor | None = None
    coords: Tensor | None = None


def prepared(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    layers: MLP,
    where: Where,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
) -> tuple[tuple[Any, ...], torch.dtype]:
    """The arguments of ``forward``, and the type of the result."""
    centres, child_offsets, child, depth, centre_weights, cells, coords = where
    own = features is not None and features.dim() == 3
    before = grouped_mlp.hashes_before(positions, weights, layers, directions)
    if own and before and weights[0].shape[0] > 1 and cells is None:
        assert coords is not None and centres is not None
        if child_offsets is None or child is None:
            cells = nearest_centre.nearest_centre(coords, centres, weights=centre_weights)
        else:
            cells = locate_cell.locate_cell(coords, centres, child_offsets, child, depth=depth, weights=centre_weights)
        centres = None
    if features is not None and own and weights[0].shape[0] == 1:
        features = features[0]
    given = network(positions, weights, biases, layers, directions, features, cells, "routed_mlp", before)
    tables = centres, child_offsets, child, centre_weights
    if cells is None and weights[0].shape[0] == 1:
        coords, tables = None, (None, None, None, None)
    samples = given.positions, given.weights, given.biases, given.table, given.directions, direction_index
    keep = grouped_mlp.keeps_encoded(given)
    return (*samples, given.features, cells, coords, *tables, depth, keep), given.dtype


@custom_op("routed_mlp_native")
def forward(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    features: Tensor | None,
    cells: Tensor | None,
    coords: Tensor | None,
    centres: Tensor | None,
    child_offsets: Tensor | None,
    child: Tensor | None,
    centre_weights: Tensor | None,
    depth: int,
    keep: bool,
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """Output, cells (empty where they are given), order (empty where there is one cell), offsets, encoded positions.

    With neither cells nor centres there is one cell.
    """
    n, k = positions.shape[0], weights[0].shape[0]
    alone = cells is None and centres is None
    out = grouped_mlp.new_output(positions, table, weights)
    found = positions.new_empty(n if cells is None else 0, dtype=torch.int32)
    order = positions.new_empty(0 if alone else n, dtype=torch.int32)
    offsets = positions.new_empty(k + 1, dtype=torch.int32)
    encoded = grouped_mlp.new_encoded(positions, table, keep)
    yield out, found, order, offsets, encoded
    if alone:
        found.zero_()
        offsets[0], offsets[1] = 0, n
    else:
        if coords is not None and centres is not None:
            if child_offsets is None or child is None:
                nearest_centre.find(found, coords, centres, centre_weights)
            else:
                locate_cell.find(found, coords, centres, child_offsets, child, depth, centre_weights, "routed_mlp")
        cell_sort.sort(found if cells is None else cells, order, offsets, "routed_mlp")
    network = positions, offsets, weights, biases, table, directions, direction_index, features
    grouped_mlp.run(out, encoded, *network, None if alone else order)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    positions, weights, biases, ctx.table, directions, direction_index, features, cells, _, centres, *_ = inputs
    _, found, order, offsets, encoded = output
    ctx.count, ctx.alone = len(weights), cells is None and centres is None
    ctx.mark_non_differentiable(found, order, offsets, encoded)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(order, offsets, encoded, positions, *weights, *biases, directions, direction_index, features)


def _backward(ctx: Any, gradient: Tensor | None, *_others: None) -> tuple[Any, ...]:
    count = ctx.count
    if gradient is None:
        return (None, [None] * count, [None] * count, *[None] * 12)
    order, offsets, encoded, *inputs = ctx.saved_tensors
    positions, *parameters, directions, direction_index, features = inputs
    to_positions, *to_parameters, to_directions, _, to_features = asked_for(ctx, inputs)
    *of_parameters, of_positions, of_directions, of_features = grouped_mlp.gradients(
        gradient,
        positions,
        offsets,
        parameters[:count],
        parameters[count:],
        ctx.table,
        directions,
        direction_index,
        features,
        None if ctx.alone else order,
        encoded,
        asked=(*to_parameters, to_positions, to_directions, to_features),
    )
    of_weights, of_biases = of_parameters[:count], of_parameters[count:]
    return of_positions, of_weights, of_biases, None, of_directions, None, of_features, *[None] * 8


forward.register_autograd(_backward, setup_context=_setup)
