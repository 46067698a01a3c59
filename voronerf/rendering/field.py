"""What can be rendered."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Field(Protocol):
    """What can be rendered: colour and density of points seen along directions."""

    def __call__(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [n, 3], directions [r, 3] (unit), ray_index int32 [n] -> rgb [n, 3] in 0..1, sigma [n] >= 0."""
        ...
