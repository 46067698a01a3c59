"""``centre_grid`` of the compiled module. k centres."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops.centre_grid.reference import GridTables, centre_table, root_bits


def centre_grid(centres: Tensor) -> GridTables:
    """A grid over all of space; see ``voronerf.ops.centre_grid``."""
    frame, entries, lists = _centre_grid(centres.detach().double())
    return GridTables(frame, entries, lists, centre_table(centres.detach()), root_bits(centres.shape[0]))


def _unknown_sizes(centres: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How large the tables become depends on where the centres are."""
    context = torch.library.get_ctx()
    entries, lists = (centres.new_empty(context.new_dynamic_size(), dtype=torch.int32) for _ in range(2))
    return centres.new_empty(2, 3, dtype=torch.float32), entries, lists


@custom_op("centre_grid", devices=("cpu",), fake=_unknown_sizes)
def _centre_grid(centres: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    compiled, k = native.compiled, centres.shape[0]
    built = compiled.centre_grid_build(centres, k, native.cpu())
    entries = centres.new_empty(compiled.centre_grid_entries(built), dtype=torch.int32)
    lists = centres.new_empty(compiled.centre_grid_lists(built), dtype=torch.int32)
    frame = centres.new_empty(2, 3, dtype=torch.float32)
    yield frame, entries, lists
    same = compiled.centre_grid_copy(built, root_bits(k), frame, entries, lists)
    assert same
