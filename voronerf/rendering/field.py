"""What can be rendered."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Field(Protocol):
    """What can be rendered: colour and density of points seen along directions.

    Examples:
        >>> import torch
        >>> from voronerf.rendering import Field
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> field: Field = fog  # any callable of this form
    """

    def __call__(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [n, 3], directions [r, 3] (unit), ray_index int32 [n] -> rgb [n, 3] in 0..1, sigma [n] >= 0."""
        ...
