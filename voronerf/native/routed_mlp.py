"""The fused route of the compiled module as a PyTorch op: locate, sort, and the networks, in one call.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams. The rows of a tile are gathered from where
the samples lie and its results written to where they belong, so that nothing but the order (int32) has n rows beside
the op's own inputs and outputs. On CUDA these are launches one after another on the current stream, and nothing is
read on the host. The backward op is that of ``grouped_mlp``, given the order. Shapes and dtypes have been validated by
``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf import native as _native
from voronerf.layers import MLP
from voronerf.native import grouped_mlp as _native_mlp


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
) -> tuple[Tensor, Tensor]:
    """Output in the order of the positions, and the cells; see ``voronerf.ops.routed_mlp``."""
    given = _native_mlp.network(positions, weights, biases, layers, directions, "routed_mlp")
    tables = centres, child_offsets, child, centre_weights
    if cells is None and weights[0].shape[0] == 1:
        coords, tables = None, (None, None, None, None)
    out, found, _, _ = _forward(
        given.positions,
        given.weights,
        given.biases,
        given.table,
        given.directions,
        direction_index,
        cells,
        coords,
        *tables,
        depth,
    )
    return out.to(given.dtype), found if cells is None else cells


@torch.library.custom_op("voronerf::routed_mlp_native", mutates_args=(), device_types=("cpu", "cuda"))
def _forward(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    cells: Tensor | None,
    coords: Tensor | None,
    centres: Tensor | None,
    child_offsets: Tensor | None,
    child: Tensor | None,
    centre_weights: Tensor | None,
    depth: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Output, cells (empty where they are given), order (empty where there is one cell) and offsets.

    With neither cells nor centres there is one cell.
    """
    n, k = positions.shape[0], weights[0].shape[0]
    found, order, offsets = _allocate(positions, k, cells, centres)
    if cells is None and centres is None:
        found.zero_()
        offsets[0], offsets[1] = 0, n
    else:
        if centres is not None:
            assert coords is not None
            _locate(found, coords, centres, child_offsets, child, centre_weights, depth)
        _native.sort_cells(found if cells is None else cells.contiguous(), order, offsets, "routed_mlp")
    out = _native_mlp.run(
        positions, offsets, weights, biases, table, directions, direction_index, order if order.numel() else None
    )
    return out, found, order, offsets


def _locate(
    cells: Tensor,
    coords: Tensor,
    centres: Tensor,
    child_offsets: Tensor | None,
    child: Tensor | None,
    centre_weights: Tensor | None,
    depth: int,
) -> None:
    """Fills ``cells``: the centres of a flat diagram, or the leaves of a tree."""
    c, threads = _native._C, torch.get_num_threads()
    coords, centres, centre_weights = coords.contiguous(), centres.contiguous(), _native._contiguous(centre_weights)
    n, m, cuda = coords.shape[0], centres.shape[0], _native.on_cuda(coords)
    if child_offsets is None or child is None:
        arguments = _native._addresses(coords, centres, centre_weights, cells)
        if cuda:
            _native._entry("nearest_centre_cuda", coords.dtype)(*arguments, n, m, *_native.stream(coords))
        else:
            _native._entry("nearest_centre", coords.dtype)(*arguments, n, m, _native._ISA, threads)
        return
    child_offsets, child = child_offsets.contiguous(), child.contiguous()
    if cuda:
        arguments = _native._addresses(coords, centres, centre_weights, child_offsets, child, cells)
        g = child_offsets.shape[0] - 1
        _native._entry("locate_cell_cuda", coords.dtype)(*arguments, n, m, g, depth, *_native.stream(coords))
        return
    fault = c.locate_cell_fault(child_offsets.data_ptr(), child.data_ptr(), child_offsets.shape[0] - 1, m)
    if fault is not None:
        raise ValueError(f"routed_mlp: {fault}")
    workspace = cells.new_empty(c.locate_cell_workspace(m, threads))
    arguments = _native._addresses(coords, centres, centre_weights, child_offsets, child, cells, workspace)
    if not _native._entry("locate_cell", coords.dtype)(*arguments, n, m, depth, _native._ISA, threads):
        raise ValueError(f"routed_mlp: depth must be the number of levels of the tree, got {depth}, which is too few")


def _allocate(positions: Tensor, k: int, cells: Tensor | None, centres: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    n = positions.shape[0]
    alone = cells is None and centres is None
    sizes = (n if cells is None else 0, 0 if alone else n, k + 1)
    found, order, offsets = (positions.new_empty(size, dtype=torch.int32) for size in sizes)
    return found, order, offsets


@_forward.register_fake
def _(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    cells: Tensor | None,
    coords: Tensor | None,
    centres: Tensor | None,
    child_offsets: Tensor | None,
    child: Tensor | None,
    centre_weights: Tensor | None,
    depth: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    out = _native_mlp._allocate(positions, table, weights)
    return out, *_allocate(positions, weights[0].shape[0], cells, centres)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor, Tensor, Tensor]) -> None:
    positions, weights, biases, ctx.table, directions, direction_index, cells, _, centres, *_ = inputs
    _, found, order, offsets = output
    ctx.count, ctx.alone = len(weights), cells is None and centres is None
    ctx.mark_non_differentiable(found, order, offsets)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(positions, directions, direction_index, order, offsets, *weights, *biases)


def _backward(ctx: Any, gradient: Tensor | None, *_: None) -> tuple[Any, ...]:
    nothing = [None] * ctx.count
    if gradient is None:
        return (None, nothing, nothing, *[None] * 10)
    positions, directions, direction_index, order, offsets, *parameters = ctx.saved_tensors
    weights, biases = parameters[: ctx.count], parameters[ctx.count :]
    needs = ctx.needs_input_grad
    results = _native_mlp._backward(
        gradient,
        positions,
        offsets,
        weights,
        biases,
        ctx.table,
        directions,
        direction_index,
        None if ctx.alone else order,
        [any(needs[1]) or any(needs[2]), needs[0], needs[4]],
    )
    return (
        results[-2] if needs[0] else None,
        [result if need else None for result, need in zip(results, needs[1])],
        [result if need else None for result, need in zip(results[ctx.count :], needs[2])],
        None,
        results[-1] if needs[4] else None,
        *[None] * 8,
    )


_forward.register_autograd(_backward, setup_context=_setup)
