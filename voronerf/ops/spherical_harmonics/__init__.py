"""Spherical harmonics, an encoding of view directions. n directions."""

from __future__ import annotations

from typing import Annotated

from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.declare import declare


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=Implementation(EVERYWHERE, FLOATS),
    smooth=["directions"],
    sizes={"w": lambda arguments: arguments.degree**2},
)
def spherical_harmonics(
    directions: Annotated[Tensor, "floating [n, 3]"], degree: Annotated[int, "1..4"], *, backend: str = "auto"
) -> Annotated[Tensor, "same [n, w]"]:
    """Returns the real spherical harmonics of bands 0 to degree - 1, an orthonormal basis of functions on the sphere.

    Müller et al. 2022 use this encoding for view directions. Values are sorted by band l, then by order from -l to l,
    and include the Condon-Shortley phase. Order, signs and constants agree with tiny-cuda-nn's ``SphericalHarmonics``
    and torch-ngp's ``SHEncoder``. As in torch-ngp the input is the direction itself; tiny-cuda-nn takes
    ``(direction + 1) / 2`` instead. The result is a polynomial in x, y and z, for vectors of any length. It has
    gradients of every order.

    Args:
        directions: unit vectors, n < 2**31.
        degree: the number of bands, 1 to 4.

    Returns:
        [n, degree**2] in the dtype of the directions: 1, 4, 9 or 16 values, computed with at least float32 precision.

    Examples:
        >>> import torch
        >>> from voronerf import spherical_harmonics
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> spherical_harmonics(up, 2).abs().round(decimals=4)  # a constant, then -y, z and -x, scaled
        tensor([[0.2821, 0.0000, 0.4886, 0.0000]])
        >>> spherical_harmonics(up, 4).shape
        torch.Size([1, 16])
    """
