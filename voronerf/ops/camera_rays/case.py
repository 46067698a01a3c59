"""The case of ``camera_rays``."""

from __future__ import annotations

import torch

from voronerf.ops.cases import Arguments, Case, Draw


def cameras(draw: Draw, c: int) -> Arguments:
    """Poses and lenses of c cameras, of every model."""
    intrinsics = torch.cat([30 + 10 * draw.uniform(c, 2), 4 * draw.uniform(c, 2)], dim=1)
    models = draw.integers(0, 3, c) if draw.free else torch.arange(c, dtype=torch.int32) % 3
    lens = {"distortion": 0.01 * draw.normal(c, 8), "models": draw.among("models", models, None)}
    return {"poses": torch.eye(4).repeat(c, 1, 1), "intrinsics": intrinsics, **lens}


def _make(draw: Draw, n: int) -> Arguments:
    c = draw.number("cameras", 3, 1, 4)
    return {**cameras(draw, c), "x": 8 * draw.uniform(n), "y": 8 * draw.uniform(n), "camera": draw.integers(0, c, n)}


CASE = Case(_make, refused={"poses must be a tensor, got str": {"poses": "x"}})
