"""Draws valid arguments of ``smooth_depth_gradient`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.composite.reference import composite


def _make(draw: Draw, n: int) -> Arguments:
    """Draws n samples on seven rays; the last six rays are two triples."""
    call: Arguments = {"loss": torch.tensor(0.5), "gradient": draw.normal(n, 4).contiguous()}
    call["ray_offsets"] = draw.offsets(n, 7)
    call |= {"density": draw.uniform(n), "depths": 0.5 + draw.uniform(n), "deltas": draw.uniform(n)}
    along = call["density"], call["density"][:, None], call["depths"], call["deltas"], call["ray_offsets"]
    rule = {"activated": True} if draw.among("activated", False, True) else {"density_scale": 3.0}
    triples = draw.number("triples", 2, 0, 2)
    call |= {"weights": composite(*along).weights, "far": 1.5 + draw.uniform(7), "triples": triples, "factor": 0.5}
    return {**call, "hidden": draw.among("hidden", 0.0, 0.5), **rule}


CASE = Case(
    _make,
    {"": {}, "activated": {"activated": True}, "hidden": {"hidden": 0.5}},
    refused={
        "ray_offsets must ascend within 0 to 6 (the number of samples), got 1 for ray 2": {
            "ray_offsets": torch.tensor([0, 2, 1, 5, 5, 5, 5, 5], dtype=torch.int32)
        },
        "triples must be at most a third of the 7 rays, got 3": {"triples": 3},
        "density_scale must be given unless the values are activated, got None": {"density_scale": None},
    },
    in_place=True,
    traced=False,
)
