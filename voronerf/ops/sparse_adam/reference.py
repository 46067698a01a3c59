"""Adam on the entries that have a gradient, in place."""

from __future__ import annotations

from collections.abc import Sequence

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


def adam(
    rules: Sequence[tuple[float, float, float, float, bool]],
    gradients: Sequence[Tensor],
    parameters: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
) -> None:
    """``sparse_adam`` of several parameters; see ``voronerf.ops.adam``.

    Args:
        rules: rate, first, second and epsilon for each parameter, and whether all of its entries move.
        gradients: of the parameters.
        parameters: any shapes.
        means: of gradients.
        squares: of squared gradients.
    """
    for (*rule, every), gradient, parameter, mean, square in zip(
        rules, gradients, parameters, means, squares, strict=True
    ):
        if not every:
            sparse_adam(parameter, gradient, mean, square, *rule)
            continue
        rate, first, second, epsilon = rule
        mean.mul_(first).add_(gradient, alpha=1 - first)
        square.mul_(second).add_(gradient.square(), alpha=1 - second)
        parameter.sub_(rate * mean / (square.sqrt() + epsilon))
