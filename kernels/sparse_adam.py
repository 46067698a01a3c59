"""Adam on the entries that have a gradient as a Warp kernel, in place. A thread takes an entry."""

from __future__ import annotations

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _sparse_adam_kernel(
    parameter: wp.array(dtype=wp.float32),
    gradient: wp.array(dtype=wp.float32),
    mean: wp.array(dtype=wp.float32),
    square: wp.array(dtype=wp.float32),
    rate: wp.float32,
    first: wp.float32,
    second: wp.float32,
    epsilon: wp.float32,
) -> None:
    i = wp.tid()
    g = gradient[i]
    if g == 0.0:
        return
    m = first * mean[i] + (1.0 - first) * g
    v = second * square[i] + (1.0 - second) * (g * g)
    mean[i] = m
    square[i] = v
    parameter[i] = parameter[i] - rate * (m / (wp.sqrt(v) + epsilon))


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
    arrays = [array(tensor.view(-1), parameter) for tensor in (parameter, gradient, mean, square)]
    launch(_sparse_adam_kernel, parameter.numel(), [*arrays, rate, first, second, epsilon], parameter)
