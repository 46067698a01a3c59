"""Adam on the entries that have a gradient, in place."""

from __future__ import annotations

import torch
from torch import Tensor


def sparse_adam(
    parameter: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    rate: float,
    first: float,
    second: float,
    epsilon: float,
) -> None:
    """The formula of ``voronerf.ops.sparse_adam``; ``rate`` and ``epsilon`` are corrected for the moments' start."""
    present = gradient != 0
    mean.copy_(torch.where(present, first * mean + (1 - first) * gradient, mean))
    square.copy_(torch.where(present, second * square + (1 - second) * gradient.square(), square))
    moved = parameter - rate * mean / (square.sqrt() + epsilon)
    parameter.copy_(torch.where(present, moved, parameter))
