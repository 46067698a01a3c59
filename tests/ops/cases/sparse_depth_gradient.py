"""Draws valid arguments of ``sparse_depth_gradient`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.composite.reference import composite


def _make(draw: Draw, n: int) -> Arguments:
    """Draws n samples on five rays; the first two have points, and the third has distance NaN."""
    call: Arguments = {name: draw.uniform(n) for name in ("density", "depths", "deltas")}
    call |= {"loss": torch.tensor(0.5), "gradient": draw.normal(n, 4).contiguous(), "ray_offsets": draw.offsets(n, 5)}
    along = call["density"], call["density"][:, None], call["depths"], call["deltas"], call["ray_offsets"]
    call["weights"] = composite(*along).weights
    rule = {"activated": True} if draw.among("activated", False, True) else {"density_scale": 3.0}
    return {**call, "distances": torch.tensor([0.4, 0.9, torch.nan]), "factor": 0.5, **rule}


CASE = Case(
    _make,
    {"": {}, "activated": {"activated": True}},
    refused={
        "ray_offsets must ascend within 0 to 6 (the number of samples), got 1 for ray 2": {
            "ray_offsets": torch.tensor([0, 2, 1, 5], dtype=torch.int32)
        },
        "distances must have at most 2 entries (the number of rays), got 3": {
            "ray_offsets": torch.tensor([0, 2, 4], dtype=torch.int32)
        },
        "density_scale must be given unless the values are activated, got None": {"density_scale": None},
    },
    in_place=True,
    traced=False,
)
