"""What native and Warp share of ``spherical_harmonics``: its arguments, and its derivatives."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from voronerf.ops._core.custom_op import Op
from voronerf.ops._core.derivatives import register_derivatives
from voronerf.ops.spherical_harmonics.reference import spherical_harmonics


class Harmonics(NamedTuple):
    """The arguments, in float32."""

    directions: Tensor
    degree: int


def register(forward: Op, backward: Op) -> None:
    """Registers the derivatives of two ops."""
    register_derivatives(forward, backward, spherical_harmonics, ("directions",))
