"""``sparse_adam`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf import native


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
    machine = native.machine(parameter)
    rule = native.compiled.SparseAdam(rate, first, second, epsilon, False)
    native.compiled.sparse_adam(rule, gradient, parameter.detach(), mean, square, parameter.numel(), machine)


def adam(
    rules: Sequence[tuple[float, float, float, float, bool]],
    gradients: Sequence[Tensor],
    parameters: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
) -> None:
    """``sparse_adam`` of several parameters on the CPU.

    Args:
        rules: rate, first, second and epsilon for each parameter, and whether entries without a gradient are updated
            too, as ``torch.optim.Adam`` does.
        gradients: of the parameters.
        parameters: float32 and contiguous, like the moments.
        means: of gradients.
        squares: of squared gradients.
    """
    compiled = native.compiled
    given = [compiled.SparseAdam(*rule) for rule in rules]
    sizes = [parameter.numel() for parameter in parameters]
    compiled.adam(given, gradients, parameters, means, squares, sizes, native.cpu())
