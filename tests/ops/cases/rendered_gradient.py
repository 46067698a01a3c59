"""Draws valid arguments of ``rendered_gradient`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.composite.reference import composite
from voronerf.ops.formulas import activate


def _make(draw: Draw, n: int) -> Arguments:
    r = (n + 3) // 4
    call: Arguments = {name: draw.normal(n, 4).contiguous() for name in ("gradient", "raw")}
    rule: Arguments = {"density_scale": 3.0}
    if draw.among("activated", False, True):
        call["raw"], rule = draw.uniform(n, 4), {"activated": True}
    rgb, call["density"] = activate(call["raw"], **rule)
    call |= {name: draw.uniform(n) for name in ("depths", "deltas")}
    call["ray_offsets"] = draw.offsets(n, r)
    call["weights"] = composite(call["density"], rgb, call["depths"], call["deltas"], call["ray_offsets"]).weights
    shapes = {"of_colour": (r, 3), "of_opacity": (r,), "of_depth": (r,)}
    shapes |= {"of_weights": (n,), "of_rgb": (n, 3), "of_density": (n,)}
    of = draw.among("of", tuple(shapes), ("of_opacity",), ("of_depth", "of_rgb"), ())
    call |= {name: draw.normal(*shape) for name, shape in shapes.items() if name in of}
    if draw.among("background", True, False):
        call["background"] = draw.uniform(*((r, 3) if draw.among("per_ray", False, True) else (3,)))
    return {**call, "hidden": draw.among("hidden", 0.0, 0.5), **rule}


CASE = Case(
    _make,
    {
        "": {},
        "opacity": {"of": ("of_opacity",)},
        "activated": {"activated": True},
        "hidden": {"hidden": 0.5},
        "backgrounds": {"per_ray": True},
    },
    refused={
        "ray_offsets must ascend within 0 to 6 (the number of samples), got 1 for ray 2": {
            "ray_offsets": torch.tensor([0, 2, 1], dtype=torch.int32)
        },
        "of_colour must be a tensor, got str": {"of_colour": "x"},
        "hidden must lie in [0, 1), got 1.0": {"hidden": 1.0},
        "density_scale must be given unless the values are activated, got None": {"density_scale": None},
        "density_scale must not be given for activated values, got 3.0": {"activated": True},
    },
    in_place=True,
    traced=False,
)
