"""The integrated encoding of mip-NeRF. n Gaussians, L octaves."""

from __future__ import annotations

from typing import Annotated

from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops._core.declare import declare


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=PLAIN,
    smooth=["means", "variances"],
    sizes={"w": lambda arguments: 6 * arguments.octaves},
)
def integrated_encode(
    means: Annotated[Tensor, "floating [n, 3]"],
    variances: Annotated[Tensor, "same [n, 3]"],
    octaves: Annotated[int, "0..127"],  # 2^128 is beyond float32
    *,
    backend: str = "auto",
) -> Annotated[Tensor, "same [n, w]"]:
    """Returns the expectation of the frequency encoding over Gaussians with diagonal covariance.

    Block l holds ``sin(2^l mu) exp(-4^l var / 2)`` and then ``cos(2^l mu) exp(-4^l var / 2)``, three features each. For
    variances of 0 the result equals ``frequency_encode`` without its input. Barron et al. 2021 (mip-NeRF), equations 13
    and 14; their code puts all sines before all cosines.

    Args:
        means: the means of the Gaussians, n < 2**31.
        variances: the variances, at least 0, in squared units of the means.
        octaves: the number of octaves L, at least 0.

    Returns:
        [n, 6L] in the dtype of the means.

    Examples:
        >>> import torch
        >>> from voronerf import integrated_encode
        >>> means = torch.tensor([[1.0, 0.0, 0.0]])
        >>> integrated_encode(means, torch.zeros(1, 3), 1).round(decimals=4)  # a point: sin, then cos
        tensor([[0.8415, 0.0000, 0.0000, 0.5403, 1.0000, 1.0000]])
        >>> integrated_encode(means, torch.full((1, 3), 4.0), 1).round(decimals=4)  # a wide Gaussian: closer to 0
        tensor([[0.1139, 0.0000, 0.0000, 0.0731, 0.1353, 0.1353]])
    """
