"""The frequency encoding of NeRF. n points, d features, L octaves."""

from __future__ import annotations

from typing import Annotated

from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.declare import declare


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=Implementation(EVERYWHERE, FLOATS),
    smooth=["x"],
    sizes={"w": lambda arguments: arguments.d * (int(arguments.include_input) + 2 * arguments.octaves)},
)
def frequency_encode(
    x: Annotated[Tensor, "floating [n, d]"],
    octaves: Annotated[int, "0..127"],  # 2^128 is beyond float32
    *,
    include_input: bool = True,
    backend: str = "auto",
) -> Annotated[Tensor, "same [n, w]"]:
    """Returns ``[x, sin x, cos x, sin 2x, cos 2x, ..., sin 2^(L-1) x, cos 2^(L-1) x]``, in blocks of d features.

    The layout follows nerf-pytorch: no factor of pi, and x itself first. Mildenhall et al. 2020, equation 4. Angles
    have at least float32 precision.

    Args:
        x: the angles of the first octave, n < 2**31.
        octaves: the number of octaves L, at least 0.
        include_input: whether x itself comes first.

    Returns:
        [n, d + 2 d L], or [n, 2 d L] without the input, in the dtype of x.

    Examples:
        >>> import torch
        >>> from voronerf import frequency_encode
        >>> x = torch.tensor([[1.0]])
        >>> frequency_encode(x, 2).round(decimals=4)  # x, sin x, cos x, sin 2x, cos 2x
        tensor([[ 1.0000,  0.8415,  0.5403,  0.9093, -0.4161]])
    """
