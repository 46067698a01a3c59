"""``update_occupancy`` of the compiled module. n cells of a grid, q updates."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf import native
from voronerf.checks import check_range
from voronerf.custom_op import custom_op


@custom_op("update_occupancy_native")
def update_occupancy(
    density: Tensor, cells: Tensor, values: Tensor, decay: float, threshold: float
) -> Iterator[tuple[Tensor, Tensor]]:
    """The larger of the density found and the decayed old one; see ``voronerf.ops.update_occupancy``."""
    remembered, occupied = density.new_empty(density.shape), density.new_empty(density.shape, dtype=torch.bool)
    yield remembered, occupied
    n, q = density.numel(), cells.shape[0]
    given = density, cells, values, remembered, occupied.view(torch.uint8), n, q, decay, threshold
    # On CUDA numbers that are not those of a cell are left out; None is no complaint.
    if native.compiled.update_occupancy(*given, native.machine(density)) is False:
        check_range("update_occupancy", "cells", cells, n)
