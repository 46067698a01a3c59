"""The case of ``sparse_depth_gradient``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    """n samples on three rays, the last of which has no point."""
    call: Arguments = {name: draw.uniform(n) for name in ("density", "depths", "deltas", "weights")}
    cuts = sorted(min(int(cut), n) for cut in draw.integers(0, n + 1, 2))
    first = draw.among("first", 0, 5)
    offsets = torch.tensor([0, *cuts, n], dtype=torch.int32) + first
    return {**call, "ray_offsets": offsets, "distances": torch.tensor([0.4, 0.9, torch.nan])}


CASE = Case(
    _make,
    refused={
        "ray_offsets must rise, by the number of samples, 6, got offsets from 0 to 5": {
            "ray_offsets": torch.tensor([0, 2, 4, 5], dtype=torch.int32)
        }
    },
    traced=False,
)
