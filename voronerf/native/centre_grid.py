"""The centre grid of the compiled module, as PyTorch ops. n points, k centres.

Arguments have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import native as _native
from voronerf.reference.centre_grid import GridTables, centre_table, root_bits


def centre_grid(centres: Tensor, *, weights: Tensor | None = None) -> GridTables:
    """A grid over all of space; see ``voronerf.ops.centre_grid``."""
    double = None if weights is None else weights.detach().double()
    frame, entries, lists = _centre_grid(centres.detach().double(), double)
    return GridTables(frame, entries, lists, centre_table(centres.detach(), weights), root_bits(centres.shape[0]))


def nearest_centre_grid(points: Tensor, centres: Tensor, grid: GridTables, *, weights: Tensor | None = None) -> Tensor:
    """Index of the nearest centre by the candidates of a point's cell; see ``voronerf.ops.nearest_centre``."""
    cells: Tensor = _nearest_centre_grid(points, centres, weights, *grid)
    return cells


# How large the tables become depends on where the centres are.
@torch.library.custom_op("voronerf::centre_grid", mutates_args=(), device_types="cpu")
def _centre_grid(centres: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    centres, weights = centres.contiguous(), None if weights is None else weights.contiguous()
    addresses = centres.data_ptr(), 0 if weights is None else weights.data_ptr()
    built = _native._C.CentreGridTables(*addresses, centres.shape[0], _native._ISA, torch.get_num_threads())
    assert built.bits == root_bits(centres.shape[0])
    entries, lists = (centres.new_empty(size, dtype=torch.int32) for size in built.sizes)
    frame = centres.new_empty(2, 3, dtype=torch.float32)
    built.copy_to(frame.data_ptr(), entries.data_ptr(), lists.data_ptr())
    return frame, entries, lists


@_centre_grid.register_fake
def _(centres: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    context = torch.library.get_ctx()
    entries, lists = (centres.new_empty(context.new_dynamic_size(), dtype=torch.int32) for _ in range(2))
    return centres.new_empty(2, 3, dtype=torch.float32), entries, lists


@torch.library.custom_op("voronerf::nearest_centre_grid", mutates_args=(), device_types="cpu")
def _nearest_centre_grid(
    points: Tensor,
    centres: Tensor,
    weights: Tensor | None,
    frame: Tensor,
    entries: Tensor,
    lists: Tensor,
    table: Tensor,
    bits: int,
) -> Tensor:
    cells = points.new_empty(points.shape[0], dtype=torch.int32)
    kept = [points.contiguous(), centres.contiguous(), None if weights is None else weights.contiguous()]
    tensors = [*kept, frame, entries, lists, table, cells]
    addresses = [0 if tensor is None else tensor.data_ptr() for tensor in tensors]
    run = _native._entry("nearest_centre_grid", points.dtype)
    run(*addresses, points.shape[0], centres.shape[0], bits, _native._ISA, torch.get_num_threads())
    return cells


@_nearest_centre_grid.register_fake
def _(
    points: Tensor,
    centres: Tensor,
    weights: Tensor | None,
    frame: Tensor,
    entries: Tensor,
    lists: Tensor,
    table: Tensor,
    bits: int,
) -> Tensor:
    return points.new_empty(points.shape[0], dtype=torch.int32)
