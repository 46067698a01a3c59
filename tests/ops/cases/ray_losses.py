"""Draws valid arguments of the losses along rays for the tests, and lists invalid arguments."""

from __future__ import annotations

from typing import Any

import torch

from cases import Arguments, Case, Draw
from voronerf.ops.composite.reference import composite


def _rays(draw: Draw, n: int, *slopes: str) -> Arguments:
    """Draws n samples on seven rays, a loss and slopes."""
    call: Arguments = {"loss": torch.tensor(0.5), "ray_offsets": draw.offsets(n, 7), "deltas": draw.uniform(n)}
    call |= {name: draw.normal(n).contiguous() for name in slopes}
    density, call["depths"] = draw.uniform(n), 0.5 + call["deltas"].cumsum(0) + 0.5 * draw.uniform(n)
    along = density, density[:, None], call["depths"], call["deltas"], call["ray_offsets"]
    return {**call, "weights": composite(*along).weights}


def _make_sparse(draw: Draw, n: int) -> Arguments:
    """The first two rays have points, and the third has distance NaN."""
    return {**_rays(draw, n, "of_weights"), "distances": torch.tensor([0.9, 1.7, torch.nan]), "factor": 0.5}


def _make_smooth(draw: Draw, n: int) -> Arguments:
    """The last six rays are two triples."""
    rays = {name: value for name, value in _rays(draw, n, "of_weights").items() if name != "deltas"}
    return {**rays, "far": 8 + draw.uniform(7), "triples": draw.number("triples", 2, 0, 2), "factor": 0.5}


def _make_surface(draw: Draw, n: int) -> Arguments:
    ends = {"near": 0.1 + draw.uniform(7), "far": 8 + draw.uniform(7)}
    options = {"distortion": 0.5, "orientation": 0.7, "hidden": draw.among("hidden", 0.0, 0.5)}
    return {**_rays(draw, n, "of_weights", "of_density"), **ends, **options}


_DESCENDS: dict[str, Any] = {
    "ray_offsets must ascend within 0 to 6 (the number of samples), got 1 for ray 2": {
        "ray_offsets": torch.tensor([0, 2, 1, 5, 5, 5, 5, 5], dtype=torch.int32)
    }
}
_SPARSE: dict[str, Any] = {
    "distances must have at most 2 entries (the number of rays), got 3": {
        "ray_offsets": torch.tensor([0, 2, 4], dtype=torch.int32)
    }
}
_SMOOTH = {"triples must be at most a third of the 7 rays, got 3": {"triples": 3}}
_SURFACE = {"hidden must lie in [0, 1), got 1.0": {"hidden": 1.0}}
_WAY: dict[str, Any] = {"in_place": True, "traced": False}
CASES = {
    "sparse_depth_loss": Case(_make_sparse, refused={**_DESCENDS, **_SPARSE}, **_WAY),
    "smooth_depth_loss": Case(_make_smooth, refused={**_DESCENDS, **_SMOOTH}, **_WAY),
    "surface_loss": Case(_make_surface, {"": {}, "hidden": {"hidden": 0.5}}, refused={**_DESCENDS, **_SURFACE}, **_WAY),
}
