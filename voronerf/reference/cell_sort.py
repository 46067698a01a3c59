"""Sorting samples by cell. n samples, k cells."""

from __future__ import annotations

import torch
from torch import Tensor


def cell_sort(cells: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Stable order and cell offsets; see ``voronerf.ops.cell_sort``."""
    if cells.device.type == "cpu" and cells.shape[0] > 0 and not torch.compiler.is_compiling():
        low, high = (int(bound) for bound in cells.aminmax())
        if low < 0 or high >= k:
            raise ValueError(f"cell_sort: cells must lie in 0 to {k - 1}, got values from {low} to {high}")
    # A narrow key makes torch's radix sort four times as fast. What is out of range (where values are not read) is kept
    # apart: below offsets[0] or from offsets[k] on.
    keys = cells.clamp(-1, k).to(torch.int16 if k < 2**15 else torch.int32)
    keys, order = torch.sort(keys, stable=True)
    bounds = torch.arange(k + 1, dtype=keys.dtype, device=cells.device)
    return order.to(torch.int32), torch.searchsorted(keys, bounds, out_int32=True)
