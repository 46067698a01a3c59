"""A step of Adam, and moving averages, in place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor


class UpdateRule(NamedTuple):
    """The Adam settings of a parameter.

    Attributes:
        step: float32 [], the number of steps done, on the device of the parameter; `adam` increments it.
        learning_rate: a number; or a tensor float32 [] on the device of the parameter, which a CUDA graph can read.
        betas: the decay rates of the two moments, in [0, 1).
        epsilon: > 0, added to the square root.
        dense: whether entries without a gradient are updated too, as in ``torch.optim.Adam``.

    Examples:
        >>> import torch
        >>> from voronerf.ops import UpdateRule
        >>> UpdateRule(torch.tensor(0.0), learning_rate=0.02, dense=False).betas
        (0.9, 0.999)
    """

    step: Tensor
    learning_rate: float | Tensor
    betas: tuple[float, float] = (0.9, 0.999)
    epsilon: float = 1e-8
    dense: bool = True


class Guard(NamedTuple):
    """A guard that skips steps with a loss or gradients that are NaN or too large.

    All tensors are float32 [] on the device of the parameters, so the host reads none of them.

    Attributes:
        skip: not 0 if the step is to be skipped; a call of `adam` with a loss sets this flag.
        skipped: the number of skipped steps, counted by calls of `adam` with a loss.
        in_a_row: the number of steps skipped since the last completed step; counted like ``skipped``.
        scale: the loss scale by which the gradients are divided; None for 1.
        limit: the limit on the magnitudes of the loss, and of the gradients whose rule has ``dense``.

    Examples:
        >>> from voronerf.ops import Guard
        >>> Guard.on("cpu").skipped
        tensor(0.)
    """

    skip: Tensor
    skipped: Tensor
    in_a_row: Tensor
    scale: Tensor | None = None
    limit: float = 1e18  # larger gradients overflow when squared, and the second moment would stay infinite

    @staticmethod
    def on(device: torch.device | str) -> Guard:
        """Returns a new guard on a device, with no skipped steps."""
        skip, skipped, in_a_row = (torch.zeros((), dtype=torch.float32, device=device) for _ in range(3))
        return Guard(skip, skipped, in_a_row)

    def begin(self, skipped: int) -> None:
        """Resets the guard and sets its number of skipped steps."""
        for tensor, value in zip(self[:3], (0, skipped, 0), strict=True):
            tensor.fill_(value)

    def judge(self, loss: Tensor | None, gradients: Sequence[Tensor]) -> None:
        """Marks the step as skipped, and counts it, unless the loss and all gradients are below the limit.

        Args:
            loss: [], the loss of the step; None leaves the guard as it is.
            gradients: The gradients to check, of any shapes.
        """
        if loss is None:
            return
        beyond = ~torch.stack(
            [(tensor.abs() < self.limit).all() for tensor in (loss, *gradients)]
        )  # NaN counts as beyond the limit
        self.skip.copy_(beyond.any())
        self.skipped.add_(self.skip)
        self.in_a_row.add_(1).mul_(self.skip)


@torch.no_grad()
def adam(
    rules: Sequence[UpdateRule],
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    guard: Guard | None,
    loss: Tensor | None,
) -> None:
    """Makes a step for several parameters; see ``voronerf.ops.adam``."""
    left_out = torch.zeros((), dtype=torch.bool, device=parameters[0].device)
    if guard is not None:
        guard.judge(loss, [gradient for rule, gradient in zip(rules, gradients) if rule.dense])
        left_out = guard.skip != 0
        if guard.scale is not None:
            gradients = [gradient / guard.scale for gradient in gradients]
    for rule, parameter, gradient, mean, square in zip(rules, parameters, gradients, means, squares, strict=True):
        first, second = rule.betas
        step = rule.step.double() + 1
        root = (1 - second**step).sqrt()
        learning_rate = rule.learning_rate
        learning_rate = learning_rate if isinstance(learning_rate, Tensor) else float(learning_rate)
        rate, epsilon = (learning_rate * root / (1 - first**step)).float(), (float(rule.epsilon) * root).float()
        new_mean = first * mean + (1 - first) * gradient
        new_square = second * square + (1 - second) * gradient.square()
        moved = parameter - rate * (new_mean / (new_square.sqrt() + epsilon))
        moves = ~left_out if rule.dense else (gradient != 0) & ~left_out
        for tensor, new in ((parameter, moved), (mean, new_mean), (square, new_square)):
            tensor.copy_(torch.where(moves, new, tensor))
        rule.step.add_(~left_out)


@torch.no_grad()
def average(averages: Sequence[Tensor], parameters: Sequence[Tensor] | None, share: float | Tensor) -> None:
    """Moves averages towards the parameters; see ``voronerf.ops.average``."""
    if parameters is None:
        torch._foreach_mul_(list(averages), 1 - share)
    else:
        torch._foreach_lerp_(list(averages), list(parameters), cast(float, share))
