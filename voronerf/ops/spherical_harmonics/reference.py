"""Spherical harmonics of directions. n directions."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core.encodings import spherical


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Returns bands 0 to degree - 1, as polynomials; see ``voronerf.ops.spherical_harmonics``."""
    return spherical(directions, degree)
