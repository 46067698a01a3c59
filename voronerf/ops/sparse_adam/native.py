"""``sparse_adam`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

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


class Rule(NamedTuple):
    """How a parameter is updated on CUDA, where the host reads no number.

    Attributes:
        rate: float32 scalar, the learning rate.
        step: float32 scalar, steps done; it is counted on unless the step is left out.
        first: decay of the mean of gradients.
        second: decay of the mean of their squares.
        epsilon: added to the root.
        every: whether entries without a gradient are updated too, as ``torch.optim.Adam`` does.
    """

    rate: Tensor
    step: Tensor
    first: float
    second: float
    epsilon: float
    every: bool


class Judged(NamedTuple):
    """Which steps were left out, float32 scalars on the device.

    Attributes:
        found: not 0 if the last step was left out.
        skipped: how many steps were left out; needed with a loss.
        in_a_row: how many of the last ones; needed with a loss.
    """

    found: Tensor
    skipped: Tensor | None = None
    in_a_row: Tensor | None = None


def adam_on_device(
    rules: Sequence[Rule],
    gradients: Sequence[Tensor],
    parameters: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    *,
    loss: Tensor | None = None,
    judged: Judged | None = None,
    scale: Tensor | None = None,
    limit: float = 1e18,
) -> None:
    """A step of Adam on CUDA for all parameters, in two launches for 40 of them; no host read.

    The step is left out where ``judged.found`` is not 0. With a loss, that is found out first: where the loss or a
    gradient of a parameter with ``every`` is not below ``limit``.

    Args:
        rules: of each parameter.
        gradients: float32, of the parameters.
        parameters: float32 and contiguous, like the moments.
        means: of gradients.
        squares: of squared gradients.
        loss: float32 scalar, or None to take ``judged.found`` as it is.
        judged: whether steps were left out; None for no step. With a loss all three are updated.
        scale: float32 scalar of which the gradients are multiples, or None.
        limit: of the loss and the gradients.
    """
    compiled = native.compiled
    found, skipped, in_a_row = judged or (None, None, None)
    guard = compiled.AdamGuard(loss=loss, limit=limit, found=found, skipped=skipped, in_a_row=in_a_row, scale=scale)
    given = [compiled.AdamRule(*rule) for rule in rules]
    sizes = [parameter.numel() for parameter in parameters]
    corrected = parameters[0].new_empty(2 * len(rules))
    machine = compiled.Cuda(*native.stream(parameters[0]))
    compiled.adam_on_device(given, guard, gradients, parameters, means, squares, sizes, corrected, machine)
