"""What native and Warp share of both frequency encodings: their arguments, and their derivatives."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from voronerf.ops._core.custom_op import Op
from voronerf.ops._core.derivatives import register_derivatives
from voronerf.ops.frequency_encode.reference import frequency_encode
from voronerf.ops.integrated_encode.reference import integrated_encode


class Encoding(NamedTuple):
    """The arguments of ``frequency_encode`` or, with variances, of ``integrated_encode``, in float32."""

    x: Tensor
    variances: Tensor | None
    octaves: int
    include_input: bool

    def result(self) -> Tensor:
        """Memory for the features."""
        n, d = self.x.shape
        return self.x.new_empty(n, d * (self.include_input + 2 * self.octaves))

    def gradients(self) -> list[Tensor]:
        """Memory for the gradients to x and to the variances, the second empty without them."""
        x, variances = self.x, self.variances
        return [x.new_empty(x.shape), x.new_empty(0 if variances is None else variances.shape)]


def register(forward: Op, backward: Op) -> None:
    """Registers the derivatives of two ops."""
    register_derivatives(forward, backward, _formula, ("x", "variances"))


def _formula(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> Tensor:
    if variances is None:
        return frequency_encode(x, octaves, include_input)
    return integrated_encode(x, variances, octaves)
