"""A step of Adam on the entries of a table that have a gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import check_dtype, check_integer, check_number, check_same_device, check_tensor, check_writable

_OP = backends.declare(
    "sparse_adam",
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
)


@torch.no_grad()
def sparse_adam(
    parameter: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    *,
    step: int,
    learning_rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    backend: str = "auto",
) -> None:
    """Updates the entries of a parameter whose gradient is not zero, in place, by Adam.

    An entry without a gradient keeps its value and both moments: they do not decay, and the entry does not move on by
    its old mean, as tiny-cuda-nn does it with its hash grids. Where the gradient is not zero, the update is that of
    Kingma and Ba 2015, algorithm 1, and of ``torch.optim.Adam``:

        mean    <- b1 mean + (1 - b1) g
        square  <- b2 square + (1 - b2) g^2
        p       <- p - rate / (1 - b1^step) mean / (sqrt(square) / sqrt(1 - b2^step) + epsilon)

    ``step`` counts the steps of the whole parameter, whether an entry had a gradient in them or not. So an entry that
    gets its first gradient late moves by less than the rate at first, by (1 - b1) / sqrt(1 - b2) of it.

    Args:
        parameter: float32, any shape, contiguous.
        gradient: float32, of the same shape. Not differentiable.
        mean: float32, of the same shape, contiguous: the first moment.
        square: float32, of the same shape, contiguous, >= 0: the second moment.
        step: the number of this step, from 1.
        learning_rate: the rate.
        betas: decay of the two moments, in [0, 1).
        epsilon: > 0, added outside of the root.
        backend: "auto", "reference", "native" or "warp".

    Raises:
        ValueError: shapes, devices, a tensor that is not contiguous, numbers out of range, an unknown backend.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf.ops import sparse_adam
        >>> table, mean, square = torch.zeros(3, 2), torch.zeros(3, 2), torch.zeros(3, 2)
        >>> gradient = torch.tensor([[0.0, 0.0], [0.5, -2.0], [0.0, 0.0]])
        >>> sparse_adam(table, gradient, mean, square, step=1, learning_rate=0.25)
        >>> table
        tensor([[ 0.0000,  0.0000],
                [-0.2500,  0.2500],
                [ 0.0000,  0.0000]])
    """
    tensors = {"parameter": parameter, "gradient": gradient, "mean": mean, "square": square}
    for name, tensor in tensors.items():
        check_tensor(_OP, name, tensor)
        check_dtype(_OP, name, tensor, (torch.float32,))
        if tensor.shape != parameter.shape:
            raise ValueError(f"{_OP}: {name} must have shape {list(parameter.shape)}, got {list(tensor.shape)}")
        if name != "gradient":
            check_writable(_OP, name, tensor)
    check_same_device(_OP, **tensors)
    check_integer(_OP, "step", step, 1)
    check_number(_OP, "learning_rate", learning_rate)
    check_number(_OP, "epsilon", epsilon)
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise TypeError(f"{_OP}: betas must be a pair of numbers, got {betas!r:.60}")
    for beta in betas:
        check_number(_OP, "betas", beta)
        if not 0 <= beta < 1:
            raise ValueError(f"{_OP}: betas must lie in [0, 1), got {betas}")
    if not epsilon > 0:
        raise ValueError(f"{_OP}: epsilon must be positive, got {epsilon}")
    run = backends.resolve(_OP, backend=backend, device=parameter.device, dtype=torch.float32)
    first, second = betas
    rate, epsilon = corrected(step, learning_rate, betas, epsilon)
    run(parameter, gradient.contiguous(), mean, square, rate, first, second, epsilon)


def corrected(step: int, learning_rate: float, betas: tuple[float, float], epsilon: float) -> tuple[float, float]:
    """Rate and epsilon with which the moments need no correction for their start at zero."""
    first, second = betas
    root = (1 - second**step) ** 0.5
    return learning_rate * root / (1 - first**step), epsilon * root
