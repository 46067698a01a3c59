"""``sparse_adam`` of the compiled module: no custom op, because it works in place on what no graph holds."""

from __future__ import annotations

from torch import Tensor

from voronerf import native


def sparse_adam(
    parameter: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    rate: float,
    correction: float,
    first: float,
    second: float,
    epsilon: float,
) -> None:
    """The formula of ``voronerf.ops.sparse_adam``; ``rate`` and ``correction`` are corrected for the moments' start."""
    machine = native.machine(parameter)
    rule = native.compiled.SparseAdam(rate, correction, first, second, epsilon)
    native.compiled.sparse_adam(rule, gradient, parameter.detach(), mean, square, parameter.numel(), machine)
