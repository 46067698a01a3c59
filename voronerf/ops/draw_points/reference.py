"""Random points in a box. n points."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops.march_rays.reference import hashed_uniforms


def draw_points(seed: Tensor, count: int, box: Tensor) -> Tensor:
    """Draws points from a box; see ``voronerf.ops.draw_points``."""
    return box[0] + (box[1] - box[0]) * hashed_uniforms(seed, count, 3).to(box.dtype)
